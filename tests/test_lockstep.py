"""Several real processes over loopback: what holds, and what happens when one of them is killed.

Promises guarded: two lockstep runs with one seed are identical to the byte; nothing is lost in
lockstep; a killed plant or controller and Ctrl-C end the run with a clear message, a readable log
and no process left over. All of it with the built-in car, and with an FMU in its place.
"""

import contextlib
import hashlib
import itertools
import json
import math
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.log import LogReader, Recorder
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY, Event, RunRequest
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.car_fmu import packed_car

ROOT = Path(__file__).resolve().parents[1]

CAR: dict[str, str] = {}
"""Plant settings that say what plays the car."""

PLANT = """
import json, sys
from plant.process import PlantSettings, main
sys.exit(main(PlantSettings.model_validate_json(sys.argv[1])))
"""

CONTROLLER = """
import sys
import numpy as np
from bayesrace.vehicles.parameters import get_car
from controller.process import ControllerSettings, main
from controller.pure_pursuit import PurePursuit, PurePursuitSettings
assert not {"casadi", "sklearn", "matplotlib", "scipy"} & set(sys.modules), "slow imports"
s = np.linspace(0, 2 * np.pi, 200, endpoint=False)
line = PurePursuit(get_car("orca"), 2 * np.cos(s), np.sin(s), np.full(200, 1.5),
                   PurePursuitSettings(seed=int(sys.argv[2])))
sys.exit(main(ControllerSettings.model_validate_json(sys.argv[1]), line))
"""


# Drives well, with a plan, for a second; then raises, then gives no number.
FAILING = """
class Failing(PurePursuit):
    count = 0
    def step(self, x, u_previous, elapsed_s, budget_s):
        self.count += 1
        if 50 < self.count <= 60:
            raise RuntimeError("no step today")
        output = super().step(x, u_previous)
        output.plan_u = np.tile(output.u, (8, 1)) * [1.0, 0.1]
        if self.count > 60:
            output.u[:] = np.nan
        return output
PurePursuit = Failing
"""


@pytest.fixture(params=["built-in car", "FMU"], autouse=True)
def _played_by(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"fmu": str(packed_car())} if request.param == "FMU" else {}
    monkeypatch.setattr(sys.modules[__name__], "CAR", settings)


@dataclass
class Rig:
    """Both processes, and a session that is connected to both."""

    plant: subprocess.Popen[str]
    controller: subprocess.Popen[str]
    session: Any
    director: Director


def request(run: int, **changes: Any) -> RunRequest:
    """A run on the oval (2 m by 1 m) from the start line at its rightmost point."""
    start = (2.0, 0.0, math.pi / 2, 0.1, 0.0, 0.0, 0.0)
    values: dict[str, Any] = {
        "lockstep": True, "x0": start, "line_x_m": 2.0, "line_y_m": 0.0,
        "line_heading_rad": math.pi / 2, "line_left_m": 0.3, "line_right_m": 0.3, "laps": 1,
        "max_time_s": 60.0, "actuation_timeout_s": 5.0,
    }  # fmt: skip
    return RunRequest(0, time.monotonic_ns(), run, **(values | changes))


def start(code: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@contextlib.contextmanager
def running_rig(
    seed: int = 1, *, low_latency: bool = True, controller_code: str = CONTROLLER
) -> Iterator[Rig]:
    at_plant, at_controller = free_endpoint(), free_endpoint()
    ends: dict[str, Any] = {"listen": [at_plant], "low_latency": low_latency}
    plant = start(PLANT, json.dumps({"endpoints": ends, "parent_pid": os.getpid(), **CAR}))
    ends = {"listen": [at_controller], "connect": [at_plant], "low_latency": low_latency}
    controller = start(
        controller_code, json.dumps({"endpoints": ends, "parent_pid": os.getpid()}), str(seed)
    )
    try:
        with open_session(Endpoints(connect=(at_plant, at_controller))) as session:
            director = Director(session, "orca")
            director.wait_for(("plant", "controller"), 20.0)
            yield Rig(plant, controller, session, director)
    finally:
        for process in (controller, plant):
            process.send_signal(signal.SIGTERM)
        for process in (controller, plant):
            output, _ = process.communicate(timeout=10)
            assert "Traceback" not in output, output


@pytest.fixture
def rig() -> Iterator[Rig]:
    with running_rig() as rig:
        yield rig


def drive(rig: Rig, path: Path, run: int, **changes: Any) -> Event:
    with Recorder(rig.session, "orca", path) as recorder:
        rig.director.wait_for(("plant", "controller"), 10.0)
        rig.director.start(request(run, **changes))
        end = rig.director.wait_for_end(run, 60.0)
    assert recorder.counters.missing == 0, recorder.gaps
    assert recorder.counters.unnumbered == recorder.counters.disordered == 0
    return end


def digest(log: Path) -> str:
    states = LogReader(log).select(STATE)
    rows = b"".join(struct.pack("<10d", s.time_s, *s.x, *s.u_applied) for s in states)
    return hashlib.sha256(rows).hexdigest()


def test_two_lockstep_runs_with_one_seed_are_identical(rig: Rig, tmp_path: Path) -> None:
    for run in (1, 2):
        end = drive(rig, tmp_path / f"{run}.mcap", run)
        assert end.data["reason"] == "laps", end.text
        assert end.data["rejected"] == end.data["refused"] == end.data["stale"] == 0
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "2.mcap")
    with running_rig() as other:
        drive(other, tmp_path / "3.mcap", 1)
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "3.mcap")
    with running_rig(seed=2) as other:
        drive(other, tmp_path / "4.mcap", 1)
    assert digest(tmp_path / "1.mcap") != digest(tmp_path / "4.mcap")


def test_the_log_of_a_lockstep_run_is_complete(rig: Rig, tmp_path: Path) -> None:
    end = drive(rig, tmp_path / "log.mcap", 7)
    log = LogReader(tmp_path / "log.mcap")
    states, actuations = log.select(STATE), log.select(ACTUATION)
    assert not log.truncated
    assert log.refused == 0
    assert states[0].time_s == 0.0
    assert states[-1].time_s == end.data["time_s"]
    assert [s.lap for s in (states[0], states[-1])] == [0, 1]
    answered = {a.state_seq: a for a in actuations}
    for before, after in itertools.pairwise(states):
        assert after.seq == before.seq + 1
        assert after.u_applied == pytest.approx(answered[before.seq].u, abs=1e-12)
    assert {t.state_seq for t in log.select(TELEMETRY)} >= {s.seq for s in states[:-1]}
    assert [e.kind for e in log.select(EVENT)] == ["run_started", "run_ended"]


def test_free_running_drives_by_the_wall_clock(tmp_path: Path) -> None:
    begin = time.monotonic()
    with running_rig(low_latency=False) as rig:
        end = drive(rig, tmp_path / "log.mcap", 1, lockstep=False, laps=0, max_time_s=1.5)
    assert end.data["reason"] == "max_time"
    assert time.monotonic() - begin > 1.5
    last = LogReader(tmp_path / "log.mcap").select(STATE)[-1]
    assert np.hypot(last.x[0] - 2.0, last.x[1]) > 0.5, "the car has not been driven"


def test_a_plant_for_lockstep_refuses_to_run_by_the_wall_clock(rig: Rig) -> None:
    with pytest.raises(InputError, match=r"started for lockstep \(--low-latency\)"):
        rig.director.start(request(1, lockstep=False))


def test_a_free_running_car_brakes_when_its_controller_dies(tmp_path: Path) -> None:
    """Without priorities or with: by the wall clock the transport's defaults are used."""
    with running_rig(low_latency=False) as rig, Recorder(rig.session, "orca", tmp_path / "log"):
        rig.director.wait_for(("plant",), 10.0)
        rig.director.start(
            request(1, lockstep=False, laps=0, max_time_s=3.0, actuation_timeout_s=0.1)
        )
        time.sleep(1.0)
        rig.controller.kill()
        end = rig.director.wait_for_end(1, 10.0, absence_s=10.0)
    assert end.data["reason"] == "max_time"
    states = LogReader(tmp_path / "log").select(STATE)
    assert max(state.x[3] for state in states) > 0.5
    assert abs(states[-1].x[3]) < 0.05
    assert int(end.data["late"]) > 20
    assert int(end.data["braked"]) > 20


@pytest.mark.slow
def test_real_time_factor_is_told(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A measurement, not a promise: what else the machine does decides it."""
    begin = time.perf_counter()
    drive(rig, tmp_path / "log.mcap", 1, laps=0, max_time_s=40.0)
    factor = 40.0 / (time.perf_counter() - begin)
    with capsys.disabled():
        print(f"\nlockstep with recorder: {factor:.1f} x real time")  # noqa: T201


def test_a_failing_step_goes_down_the_levels_and_the_car_stops(tmp_path: Path) -> None:
    code = CONTROLLER.replace("assert not", FAILING + "assert not")
    with running_rig(controller_code=code) as rig:
        end = drive(rig, tmp_path / "log.mcap", 1, laps=0, max_time_s=4.0)
        status = rig.director.status("controller")
    assert end.data["reason"] == "max_time"
    log = LogReader(tmp_path / "log.mcap")
    levels = [telemetry.fallback for telemetry in log.select(TELEMETRY)]
    assert levels[:50] == [0] * 50
    assert [key for key, _ in itertools.groupby(levels)] == [0, 1, 2, 3]
    assert status.counters["raised"] == 10
    assert "RuntimeError: no step today" in status.text
    assert status.counters["stop"] == levels.count(3)
    assert abs(log.select(STATE)[-1].x[3]) < 0.05


def test_a_killed_controller_ends_a_lockstep_run(rig: Rig, tmp_path: Path) -> None:
    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        rig.director.wait_for(("plant",), 10.0)
        rig.director.start(request(1, laps=0, max_time_s=1e5))
        time.sleep(0.5)
        rig.controller.kill()
        end = rig.director.wait_for_end(1, 5.0)
    assert end.data["reason"] == "controller_lost"
    assert "controller vanished" in end.text
    states = LogReader(tmp_path / "log.mcap").select(STATE)
    assert states
    assert states[-1].time_s == end.data["time_s"]
    with pytest.raises(InputError, match="no controller for car 'orca'"):
        rig.director.start(request(2))
    assert rig.director.status("plant").phase == "idle"


def test_a_killed_plant_is_noticed_by_everyone(rig: Rig, tmp_path: Path) -> None:
    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        rig.director.start(request(1, laps=0, max_time_s=1e5))
        time.sleep(0.5)
        rig.plant.kill()
        with pytest.raises(InputError, match="plant of car 'orca' vanished during run 1"):
            rig.director.wait_for_end(1, 5.0)
    assert LogReader(tmp_path / "log.mcap").select(STATE)
    status = rig.director.status("controller")
    assert (status.phase, "plant vanished" in status.text) == ("waiting", True)


def test_ctrl_c_ends_plant_and_run_cleanly(rig: Rig, tmp_path: Path) -> None:
    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        rig.director.start(request(1, laps=0, max_time_s=1e5))
        time.sleep(0.3)
        for process in (rig.plant, rig.controller):
            process.send_signal(signal.SIGINT)
        assert rig.plant.wait(5.0) == 0
        assert rig.controller.wait(5.0) == 0
    log = LogReader(tmp_path / "log.mcap")
    ends = [event for event in log.select(EVENT) if event.kind == "run_ended"]
    assert [event.data["reason"] for event in ends] in (["interrupted"], ["controller_lost"])


def test_a_run_is_stopped_on_request_and_another_refused_meanwhile(rig: Rig) -> None:
    rig.director.start(request(1, laps=0, max_time_s=1e5))
    with pytest.raises(InputError, match="busy: run 1 under way"):
        rig.director.start(request(2))
    assert rig.director.status("plant").phase == "running"
    assert rig.director.stop("enough").accepted
    end = rig.director.wait_for_end(1, 5.0)
    assert end.data["reason"] == "stopped"
    assert "enough" in end.text
    assert not rig.director.stop("again").accepted


def test_weights_for_a_controller_without_any_are_refused_with_a_reason(rig: Rig) -> None:
    with pytest.raises(InputError, match="pure pursuit takes no weights"):
        rig.director.send_weights(bytes(200_000))
    assert rig.director.status("controller").counters["weights_refused"] == 1


@pytest.mark.parametrize("after_s", [0.0, 1.5])
def test_processes_do_not_outlive_who_started_them(after_s: float) -> None:
    """Whether the parent dies while the child runs or while it is still starting."""
    starter = (
        "import os, subprocess, sys, time, json\n"
        "from bayesrace.transport import free_endpoint\n"
        "s = {'endpoints': {'listen': [free_endpoint()]}, 'parent_pid': os.getpid()}\n"
        "s = json.dumps(s | json.loads(sys.argv[2]))\n"
        "p = subprocess.Popen([sys.executable, '-c', sys.argv[1], s])\n"
        "print(p.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = start(starter, PLANT, json.dumps(CAR))
    assert parent.stdout is not None
    assert parent.stdout.readline().strip().isdigit()
    time.sleep(after_s)
    parent.kill()
    parent.communicate(timeout=10)  # returns when the child, which holds the pipe too, has ended
