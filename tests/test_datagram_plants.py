"""examples/datagram_plants: plants without BayesRace's code, driven by the controller without
Python over UDP."""

import os
import re
import select
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console

from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import read_weights
from bayesrace.messages import ACTUATION, STATE, Actuation, State, from_datagram, to_datagram
from bayesrace.messages.codec import schema_version
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.host import HostProgram
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.tracks import write_track
from bayesrace.vehicles import Car, get_car
from tests.conftest import Circuit
from tests.fake_f1tenth_gym import STEP_S, FakeGym
from tests.native_programs import SANITIZERS, STRICT, gcc
from tests.network.cars import free_port, started_host
from tests.programs import ROOT

FOLDER = ROOT / "examples" / "datagram_plants"
LANGUAGES = ("C", "Python")
PRECISE = "-ffp-contract=off"
"""As in the example's Makefile: sums and products are rounded as in Python."""

Line = Callable[..., list[str]]
"""Command line of a plant: language, its controller's port, laps, whether in real time."""


@pytest.fixture(scope="module")
def line(circuit: Circuit, tmp_path_factory: pytest.TempPathFactory) -> Line:
    folder = tmp_path_factory.mktemp("plants")
    write_track(folder / "track.csv", circuit.track)
    gcc(*SANITIZERS, "-O1", PRECISE, *STRICT, FOLDER / "plant.c", "-lm", "-o", folder / "plant")

    def made(language: str, port: int, laps: int = 1, realtime: bool = False) -> list[str]:
        track = str(folder / "track.csv")
        if language == "C":
            words = [str(folder / "plant"), track, "127.0.0.1", str(port), str(laps)]
            return [*words, "realtime"] if realtime else words
        words = [sys.executable, str(FOLDER / "python_plant.py"), track, "--laps", str(laps)]
        words += ["--to", f"127.0.0.1:{port}", "--car", str(ROOT / "bayesrace/cars/orca.toml")]
        return [*words, "--realtime"] if realtime else words

    return made


@pytest.fixture(scope="module")
def port(host: HostProgram) -> Iterator[int]:
    """Of a running controller."""
    number = free_port()
    with started_host(host, f"udp:127.0.0.1:{number}"):
        yield number


class Relay(threading.Thread):
    """A link of one plant to a controller, on which something happens."""

    def __init__(self, to: int) -> None:
        super().__init__(daemon=True)
        self.states: list[State] = []
        self.answers: Callable[[bytes], list[bytes]] = lambda data: [data]
        """What the plant gets for a datagram of the controller."""
        self._plant, self._controller = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        self._plant.bind(("127.0.0.1", 0))
        self._controller.connect(("127.0.0.1", to))
        self.port = int(self._plant.getsockname()[1])
        self._over = threading.Event()

    def run(self) -> None:
        there = ("", 0)
        while not self._over.is_set():
            for one in select.select([self._plant, self._controller], [], [], 0.1)[0]:
                data, sender = one.recvfrom(1 << 16)
                if one is self._controller:
                    for answer in self.answers(data):
                        self._plant.sendto(answer, there)
                    continue
                there = sender
                topic, state = from_datagram(data)
                assert topic is STATE
                assert isinstance(state, State)
                self.states.append(state)
                self._controller.send(data)

    def close(self) -> None:
        self._over.set()
        self.join()
        self._plant.close()
        self._controller.close()


@contextmanager
def relayed(to: int) -> Iterator[Relay]:
    relay = Relay(to)
    relay.start()
    yield relay
    relay.close()


def laps_s(said: str) -> list[float]:
    return [float(time_s) for time_s in re.findall(r"lap \d+: ([\d.]+) s", said)]


def ended(words: list[str], code: int = 0) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == code, done.stderr
    return done


def test_the_makefile_compiles_the_c_plant_without_a_warning(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "plants")
    subprocess.run(["make", "-s", "-C", str(tmp_path / "plants")], check=True)
    assert (tmp_path / "plants" / "plant").exists()


def test_plants_in_c_and_python_drive_the_laps_of_the_built_in_one(
    line: Line, port: int, native: NativeStep, circuit: Circuit, car: Car
) -> None:
    """But for slow wheels, below 0.1 m/s, where its equations are smoother."""
    expected = ClosedLoop(car, circuit.track, circuit.line, PredictiveController(native)).drive(2)
    found = {one: laps_s(ended(line(one, port, laps=2)).stdout) for one in LANGUAGES}
    assert len(found["C"]) == 2
    np.testing.assert_allclose(found["C"], found["Python"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["C"], expected.laps_s, rtol=0, atol=1e-6)


def test_another_kind_of_car_is_refused(line: Line) -> None:
    words = line("Python", free_port())
    words[-1] = str(ROOT / "bayesrace/cars/f1tenth.toml")
    assert "f1tenth.toml: not a car on Pacejka tyres" in ended(words, code=2).stderr


def test_the_documented_fields_of_a_state_are_those_of_the_message() -> None:
    section = (ROOT / "docs/host.md").read_text().split("## A plant of your own")[1]
    table = section.split("| field |")[1].split("\n\n")[0]
    rows = [line.split("|")[1:4] for line in table.splitlines()[2:]]
    names = [name for cell, *_ in rows for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(names) == sorted(["schema", *State.__struct_fields__])
    assert rows[0][2].strip() == str(schema_version(State))


def foreign_and_damaged(data: bytes, random: np.random.Generator) -> list[bytes]:
    """What is no answer for this run, and would steer the car if it counted; then the answer."""
    _, message = from_datagram(data)
    if not isinstance(message, Actuation):
        return [data]
    wild = replace(message, u=(1e3, 1e3))
    other = [replace(wild, epoch=wild.epoch + 1), replace(wild, run=2), replace(wild, state_seq=0)]
    begin = to_datagram(ACTUATION, wild)
    damaged = [begin[:-k] for k in (1, 9, 40, len(begin) - 2)]
    key = begin.index(b"\xa1u\x92") + 3  # the numbers of u: of NaN, no number, missing
    nan, text = b"\xcb\x7f\xf8" + bytes(6), b"\xa8" + b"sideways"
    damaged += [begin[:key] + one + begin[key + 9 :] for one in (nan, text)]
    damaged += [begin[: key - 1] + b"\x90" + begin[key + 18 :], b"", b"\x92\xa9actuation\xdf\xff"]
    damaged += [random.bytes(int(n)) for n in random.integers(1, 400, 4)]
    return [to_datagram(ACTUATION, one) for one in other if one != message] + damaged + [data]


@pytest.mark.parametrize("language", LANGUAGES)
def test_foreign_and_damaged_datagrams_steer_nothing(line: Line, port: int, language: str) -> None:
    """The laps are those of an undisturbed link; of C without a sanitizer's finding."""
    random = np.random.default_rng(1)
    with relayed(port) as relay:
        quiet = laps_s(ended(line(language, relay.port)).stdout)
        relay.answers = lambda data: foreign_and_damaged(data, random)
        assert laps_s(ended(line(language, relay.port)).stdout) == quiet


@pytest.mark.parametrize("language", LANGUAGES)
def test_in_lockstep_a_state_without_an_answer_is_repeated(
    line: Line, port: int, language: str
) -> None:
    lost: list[bytes] = []

    def loses_one(data: bytes) -> list[bytes]:
        if len(relay.states) < 20 or lost or from_datagram(data)[0] is not ACTUATION:
            return [data]
        lost.append(data)
        return []

    with relayed(port) as relay:
        relay.answers = loses_one
        assert len(laps_s(ended(line(language, relay.port)).stdout)) == 1
    numbers = [state.seq for state in relay.states]
    first, *again = (replace(one, source_time_ns=0) for one in relay.states if one.seq == 19)
    assert again == [first] * len(again) != []
    assert sorted(set(numbers)) == list(range(numbers[-1] + 1))
    assert relay.states[-1].final


@pytest.mark.parametrize("language", LANGUAGES)
def test_without_a_controller_a_plant_in_lockstep_ends(line: Line, language: str) -> None:
    assert "no answer" in ended(line(language, free_port()), code=1).stderr


def with_one_of_the_future(data: bytes) -> list[bytes]:
    """Beside which every later answer would count as overtaken."""
    _, message = from_datagram(data)
    if not isinstance(message, Actuation):
        return [data]
    return [to_datagram(ACTUATION, replace(message, decided_at_s=1e6, u=(1.0, 5.0))), data]


@pytest.mark.wall_clock
@pytest.mark.parametrize("language", LANGUAGES)
def test_in_real_time_the_car_laps_and_brakes_on_its_track_when_answers_end(
    line: Line, port: int, language: str, circuit: Circuit
) -> None:
    """By the plan that the controller has sent ahead."""
    lockstep = laps_s(ended(line(language, port)).stdout)
    with relayed(port) as relay:
        relay.answers = lambda data: (
            with_one_of_the_future(data) if not relay.states[-1].lap else []
        )
        done = ended(line(language, relay.port, laps=3, realtime=True), code=1)
    assert "the car stands" in done.stderr
    np.testing.assert_allclose(laps_s(done.stdout), lockstep, rtol=0.2)  # on a loaded machine, too
    assert any(state.actuation_delays for state in relay.states)
    x = np.array([state.x for state in relay.states])
    assert x[:, 3].max() > 2.0
    assert abs(x[-1, 3]) < 0.02
    silent = [state.lap for state in relay.states].index(1)
    assert circuit.track.project_path(x[silent:, :2]).off_track_m.max() <= 0


@pytest.fixture
def gym_plant(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The adapter as a module; it imports the plant in Python beside it."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import f1tenth_gym_plant  # type: ignore[import-not-found]

    return f1tenth_gym_plant  # type: ignore[no-any-return]


def test_the_gyms_car_accelerates_and_steers_as_commanded(gym_plant: ModuleType) -> None:
    """The adapter knows the steering angle that the observation lacks."""
    env = FakeGym(get_car("f1tenth"))
    car = gym_plant.GymCar(env, (0.0, 0.0, 0.3))
    random = np.random.default_rng(2)
    angle = 0.0
    for k in range(600):
        d, rate = random.uniform(-6, 8 if env.x[3] < 4 else 0), random.uniform(-1.5, 1.5)
        before = env.x.copy()
        acted = car.step(d, rate)
        angle = float(np.clip(angle + acted[1] * STEP_S, -0.4189, 0.4189))
        assert abs(car.delta - env.x[6]) < 1e-12
        assert abs(angle - env.x[6]) < 1e-9
        if before[3] > 0.5:
            rise = np.hypot(*env.x[3:5]) - np.hypot(*before[3:5])
            assert abs(rise / STEP_S - acted[0]) < 0.05, k
    reading = car.measured(6.0)["readings"][0]
    assert set(reading["values"]) == {"x", "y", "psi", "vx", "omega", "delta"}


def test_a_collision_in_the_gym_ends_the_plant(gym_plant: ModuleType) -> None:
    env = FakeGym(get_car("f1tenth"))
    car = gym_plant.GymCar(env, (0.0, 0.0, 0.0))
    env.collides = True
    with pytest.raises(SystemExit, match="hit"):
        car.step(1.0, 0.0)


@pytest.mark.check
def test_the_gyms_car_drives_laps_by_estimated_states(tmp_path: Path) -> None:
    """As the program is started; the gym is a fake of that name."""
    car = get_car("f1tenth")
    with stages_on(Console(quiet=True)) as stages:
        files = prepare(PreparationSettings(car="f1tenth"), ("workshop",), stages)
    on, weights = files.first, read_weights(files.weights)
    drives_by = files.artefacts[0], car, on.track, on.line, weights, MpcSettings()
    (tmp_path / "host").mkdir()
    controller = HostProgram.made(tmp_path / "host", *drives_by)
    write_track(tmp_path / "track.csv", on.track)
    (tmp_path / "gym.py").write_text(
        "from bayesrace.vehicles import get_car\n"
        "from tests.fake_f1tenth_gym import FakeGym\n"
        "def make(name, map, map_ext, num_agents):\n"
        "    assert (name, map, map_ext, num_agents) == ('f110_gym:f110-v0', 'a', '.png', 1)\n"
        "    return FakeGym(get_car('f1tenth'))\n"
    )
    number = free_port()
    words = [sys.executable, str(FOLDER / "f1tenth_gym_plant.py"), str(tmp_path / "track.csv")]
    words += ["--map", "a", "--to", f"127.0.0.1:{number}"]
    paths = os.pathsep.join((str(tmp_path), str(ROOT)))
    with started_host(controller, f"udp:127.0.0.1:{number}"):
        done = subprocess.run(
            words, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True,
            check=False, timeout=240,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    controller_in_python = compiled_controller(files.artefacts[0], car, on.track, on.line, weights)
    plain = ClosedLoop(car, on.track, on.line, controller_in_python).drive(2)
    np.testing.assert_allclose(laps_s(done.stdout), plain.laps_s, rtol=0.01)
