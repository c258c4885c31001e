"""The plugin for users' tests: docs/pytest.md is true, and no process outlives a test."""

import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import bayesrace as br
from bayesrace.arrays import Floats, Rows
from tests.programs import ROOT, environment, finish, until
from tests.racing import prepared

PLANT = (sys.executable, "-m", "bayesrace.operation.cli", "plant")
CONTROLLER = (sys.executable, "-m", "bayesrace.operation.cli", "controller")

Loop = Callable[..., br.Run]
System = Callable[..., br.testing.SystemRun]


@dataclass
class Project:
    """A user's project with one file of tests, and nothing of the pytest that runs this."""

    folder: Path
    environment: dict[str, str] = field(
        default_factory=lambda: {
            name: value for name, value in environment().items() if not name.startswith("PYTEST")
        }
    )

    def start(self, tests: str, *options: str) -> subprocess.Popen[str]:
        (self.folder / "test_my_car.py").write_text(tests)
        line = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", "."]
        return subprocess.Popen(
            [*line, "--basetemp", str(self.kept), *options], cwd=self.folder, text=True,
            env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    @property
    def kept(self) -> Path:
        return self.folder / "kept"

    @property
    def log(self) -> Path:
        return next(self.kept.rglob("run.mcap"), self.kept)

    def processes(self) -> list[str]:
        """Command lines of what was started with files of this project, and still runs."""
        found = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                words = (entry / "cmdline").read_bytes().decode().split("\0")
            except OSError:  # it has just ended
                continue
            if any(str(self.kept / "test") in word for word in words):
                found.append(" ".join(words))
        return found

    def check_released(self) -> None:
        """Processes and sockets are gone."""
        until(lambda: not self.processes(), "the end of plant and controller", 20.0)
        (text,) = {file.read_text() for file in self.kept.rglob("bayesrace.toml")}
        sockets = re.findall(r"unixsock-stream/([^\"]+)", text)
        assert len(sockets) == 2
        assert not [one for one in sockets if Path(one).exists()]


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return Project(tmp_path)


def drives(options: str) -> str:
    """A test of a learned car that takes longer than is asked."""
    return (
        "import bayesrace as br\n\n\ndef test_laps(bayesrace_system):\n"
        f"    run = bayesrace_system(weights={str(prepared().weights)!r}, {options})\n"
        "    br.testing.assert_lap(run, at_most_s=1)\n"
    )


def test_the_pages_project_passes(project: Project) -> None:
    page = (ROOT / "docs" / "pytest.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)
    assert len(code.splitlines()) < 50
    done = finish(project.start(code))
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout
    project.check_released()


def test_a_failure_names_the_folder_that_keeps_log_and_outputs(project: Project) -> None:
    done = finish(project.start(drives("laps=1")))
    assert done.returncode == 1, done.stdout
    for words in (r"laps\[-1\] took \d\.\d+ s, more than 1 s", "fallbacks: 0", r"1 lap\(s\) done"):
        assert re.search(words, done.stdout), done.stdout
    named = re.search(r"kept in (\S+): run.mcap, plant.log, controller.log", done.stdout)
    assert named, done.stdout
    folder = Path(named[1])
    assert len(br.Log(folder / "run.mcap")["state"]) > 300
    assert "plant of car 'orca'" in (folder / "plant.log").read_text()
    assert (folder / "controller.log").exists()
    project.check_released()


@pytest.mark.wall_clock
@pytest.mark.parametrize(
    ("ended", "code"),
    [
        ("interrupted", 2),
        ("killed", -signal.SIGKILL),
        pytest.param("timed out", 1, marks=pytest.mark.check),
    ],
)
def test_processes_end_with_the_test_however_it_ends(
    project: Project, ended: str, code: int
) -> None:
    options = ("--timeout", "20", "--timeout-method", "signal") if ended == "timed out" else ()
    plant = [*PLANT, "--car", "{car}", "--endpoint", "{plant}"] if ended == "killed" else []
    process = project.start(drives(f"laps=100, mode='realtime', plant={plant}"), *options)
    if ended != "timed out":
        until(lambda: project.log.is_file() and project.log.stat().st_size > 50_000, "a drive")
        assert len(project.processes()) == 2
        process.send_signal(signal.SIGINT if ended == "interrupted" else signal.SIGKILL)
    done = finish(process)
    assert done.returncode == code, done.stdout
    until(lambda: not project.processes(), "the end of plant and controller", 20.0)
    if ended != "killed":  # sockets are the parent's to remove
        project.check_released()
    if ended == "timed out":
        assert "kept in" in done.stdout
    assert len(br.Log(project.log)["state"]) > 10


def test_the_plugin_alone_imports_nothing(project: Project) -> None:
    tests = (
        "import sys\n\n\ndef test_modules(pytestconfig):\n"
        "    assert pytestconfig.pluginmanager.has_plugin('bayesrace')\n"
        "    ours = {one for one in sys.modules if one.split('.')[0] == 'bayesrace'}\n"
        "    light = {'bayesrace.api', 'bayesrace.testing', 'bayesrace.errors'}\n"
        "    assert ours <= {'bayesrace', *light}\n"
        "    assert not {'numpy', 'zenoh', 'casadi', 'pydantic', 'msgspec'} & {*sys.modules}\n"
    )
    for name in [name for name in project.environment if "COVERAGE_" in name]:
        del project.environment[name]  # measuring imports much
    done = finish(project.start(tests))
    assert done.returncode == 0, done.stdout


def test_two_processes_in_lockstep_drive_what_one_does(
    bayesrace_loop: Loop, bayesrace_system: System
) -> None:
    options = {"weights": prepared().weights, "sensors": "mocap", "seed": 3, "delay_ms": 5}
    one, two = bayesrace_loop(**options), bayesrace_system(**options)
    assert one.laps == two.laps
    np.testing.assert_array_equal(one.off_track_m, two.off_track_m)
    np.testing.assert_array_equal(one.level, two.level)
    assert two.statuses["plant"].delay_s == 0.005
    assert two.verdict.passed
    assert "passed: 2 laps" in repr(two)
    assert two.log.car == br.Car.load("orca")
    br.testing.assert_lap(two, at_most_s=8)


def test_plant_and_controller_may_be_commands_of_ones_own(
    bayesrace_system: System,
) -> None:
    options = {"weights": prepared().weights, "laps": 1, "settings": {"caution": 0.5}}
    plant = [*PLANT, "--car", "{car}", "--endpoint", "{plant}"]
    names = ("car", "track", "artefact", "weights", "settings")
    files = [word for name in names for word in (f"--{name}", f"{{{name}}}")]
    where = ["--endpoint", "{plant}", "--listen", "{controller}"]
    controller = [*CONTROLLER, *files, "--raceline", "{line}", *where]
    run = bayesrace_system(plant=plant, controller=controller, **options)
    assert run.laps == bayesrace_system(**options).laps
    assert run.statuses["plant"].phase == "idle"


def test_a_command_that_does_not_start_is_explained(
    bayesrace_system: System,
) -> None:
    with pytest.raises(br.InputError, match=r"plant ended with code 1: no-such-plant cannot be"):
        bayesrace_system(plant=["no-such-plant"])


def test_what_would_have_no_effect_is_refused(
    bayesrace_loop: Loop, bayesrace_system: System
) -> None:
    with pytest.raises(br.InputError, match="delay_ms: the plant is a command of its own"):
        bayesrace_system(plant=PLANT, delay_ms=5)
    car, track = br.Car.load("orca"), br.Track.load("harbour")
    with pytest.raises(br.InputError, match="seed: the simulator is your own"):
        bayesrace_loop(simulator=br.Simulator(car, track), seed=5)
    with pytest.raises(br.InputError, match="laps"):
        bayesrace_system(laps=0)


@dataclass
class Driven:
    """A run as far as an assertion sees it."""

    laps: tuple[float, ...] = (7.0, 6.5)
    asked: int = 2
    off_track_m: Floats = field(default_factory=lambda: np.array([-0.1, 0.02, 0.034]))
    off_track: int = 2
    level: Rows = field(default_factory=lambda: np.array([0, 1, 2]))
    end: str = "2 lap(s) done"


def test_an_assertion_passes_for_the_lap_that_is_asked() -> None:
    br.testing.assert_lap(Driven(), off_track=2)
    br.testing.assert_lap(Driven(), 6.5, off_track=2)
    br.testing.assert_lap(Driven(), 7.0, off_track=2, lap=0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"off_track": 2, "at_most_s": 6.4}, "laps[-1] took 6.500 s, more than 6.4 s"),
        ({"off_track": 2, "at_most_s": float("nan")}, "laps[-1] took 6.500 s, more than nan s"),
        ({"off_track": 2, "lap": 2}, "laps[2] was not driven"),
        ({"off_track": 2, "lap": -3}, "laps[-3] was not driven"),
        ({}, "2 samples are off the track, more than 0"),
    ],
)
def test_an_assertion_that_fails_says_what_happened(options: dict[str, float], words: str) -> None:
    with pytest.raises(AssertionError, match=re.escape(words)) as failure:
        br.testing.assert_lap(Driven(), **options)  # type: ignore[arg-type]
    for fact in ("7.000, 6.500 s", "2 samples, deepest 0.034 m", "fallbacks: 2", "2 lap(s) done"):
        assert fact in str(failure.value)


def test_a_run_without_a_lap_says_so() -> None:
    with pytest.raises(AssertionError, match=r"0 of 2 laps were driven; [^\n]*\n  laps: none"):
        br.testing.assert_lap(Driven(laps=()))


def test_a_run_that_stopped_early_is_none_that_passed() -> None:
    with pytest.raises(AssertionError, match="1 of 2 laps were driven"):
        br.testing.assert_lap(Driven(laps=(6.5,)), 7.0, off_track=2)
