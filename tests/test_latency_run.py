"""``bayesrace latency`` as its users have it: real processes, real clocks; no time is judged."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import STATE
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.realtime import RealtimeSettings
from bayesrace.studies.latency import beside
from bayesrace.studies.latency.beside import read_bare_loop, read_round_trips, running_beside
from bayesrace.studies.latency.legs import BESIDE, LEGS
from bayesrace.studies.latency.measure import _wait_for_run
from bayesrace.tracks import Track
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.command_line import Cli, refused
from tests.network.cars import Program
from tests.programs import _arguments, finish, leftovers, peanut, start, until
from tests.shared import session_folder

pytestmark = pytest.mark.wall_clock


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """Everything a controller needs on the shortest track."""
    from rich.console import Console

    track = peanut(tmp_path_factory.mktemp("track") / "peanut.csv")
    with stages_on(Console(quiet=True)) as stages:
        return prepare(PreparationSettings(), (str(track),), stages)


@dataclass
class Run:
    """One measurement."""

    out: Path
    printed: str

    @property
    def result(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.out / "latency.json").read_text())
        return content


@pytest.fixture(scope="module")
def loaded(files: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A short run with a busy process beside, measured once for all workers."""

    def make(folder: Path) -> None:
        process = start(
            "latency", *files.arguments, "--duration", "3", "--load", "1", "--out", folder / "run",
            "--json", folder / "copy.json",
        )  # fmt: skip
        done = finish(process)
        assert done.returncode == 0, done.stderr
        assert json.loads((folder / "copy.json").read_text()) is not None
        # plant, controller, load and what is measured beside carry its process number
        assert not leftovers(process.pid)
        assert not _with_parent(process.pid)
        (folder / "stdout").write_text(done.stdout.replace(str(folder / "run"), "RUN"))

    folder = session_folder(tmp_path_factory, "latency", make)
    return Run(folder / "run", (folder / "stdout").read_text())


def test_every_leg_is_measured(loaded: Run) -> None:
    result = loaded.result
    assert set(result["legs_us"]) == set(LEGS)
    for name, leg in result["legs_us"].items():
        assert leg["count"] >= 10, name
        assert leg["p50"] <= leg["p90"] <= leg["p99"] <= leg["p999"] <= leg["max"], name
        assert leg["below_zero"] == 0, name
    assert result["bare_loop_us"]["count"] > 0
    assert result["bare_loop_misses"] == result["bare_loop_us"]["misses"]
    passed = result["round_trip_us"]
    assert passed["count"] > 0
    assert 0 < passed["p50"] < result["state_to_actuation_us"]["max"]


def test_messages_memory_laps_and_clocks_are_reported(loaded: Run) -> None:
    result = loaded.result
    assert all(one["complete"] for one in result["traffic"].values())
    in_flight = sum(one["in_flight"] for one in result["traffic"].values())
    assert result["sent"] == result["received"] + result["lost"] + in_flight
    assert result["sent"] > 100
    assert set(result["rss"]) == {"plant", "controller"}
    assert result["rss_growth_bytes"] >= 0
    assert (result["clocks"]["shared"], result["clocks"]["uncertainty_us"]) == (True, 0)
    assert result["states"] > 100
    assert result["off_track_samples"] is not None
    for words in ("state → actuation", "bare loop", "sent =", "one clock", "RUN"):
        assert words in loaded.printed.replace("\n", " "), words


def test_files_are_those_of_the_documentation(loaded: Run) -> None:
    names = {path.name for path in loaded.out.iterdir()}
    assert {"latency.json", "latency.png", "legs.npz", "settings.json", "run.mcap"} <= names
    with np.load(loaded.out / "legs.npz") as values:
        assert set(values) == {*LEGS, *BESIDE}
        for name in values:
            leg = loaded.result["legs_us"].get(name) or loaded.result[f"{name}_us"]
            assert values[name].shape == (2, leg["count"]), name


def test_the_log_of_a_run_gives_the_same_legs_again(loaded: Run, cli: Cli, tmp_path: Path) -> None:
    log = loaded.out / "run.mcap"
    done = cli("latency", "--log", log, "--duration", "3", "--out", tmp_path / "again")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "again" / "latency.json").read_text())
    for name in ("legs_us", "ticks", "traffic", "clocks", "laps", "rate_hz", "overruns"):
        assert result[name] == loaded.result[name], name
    assert result["recorded"] is True
    assert result["bare_loop_us"] is None
    assert "recorded" in done.out


def _with_parent(pid: int, word: str = "--parent-pid") -> list[int]:
    """Processes that end with this one, those whose command line has this word."""
    lines = {int(entry.name): _arguments(entry.name) for entry in Path("/proc").glob("[0-9]*")}
    parent = f"--parent-pid {pid} "
    return [one for one, words in lines.items() if parent in " ".join(words) and word in words]


def _observing(out: Path) -> bool:
    """Whether the log goes on beyond the warm-up."""
    time.sleep(0.5)
    log = out / "run.mcap"
    states = LogReader(log).select(STATE) if log.is_file() else []
    return bool(states) and states[-1].time_s > 4.0


@pytest.mark.check
def test_killed_controller_ends_it_with_a_reason_and_a_report(
    files: Prepared, tmp_path: Path
) -> None:
    process = start("latency", *files.arguments, "--duration", "60", "--out", tmp_path / "run")
    until(lambda: _observing(tmp_path / "run"), "time observed")
    (controller,) = _with_parent(process.pid, "controller")
    os.kill(controller, signal.SIGKILL)
    done = finish(process)
    assert done.returncode == 1
    assert "controller" in done.stderr
    assert "killed by signal 9" in done.stderr
    notes = json.loads((tmp_path / "run" / "latency.json").read_text())["notes"]
    assert any("ended early" in note for note in notes)
    assert not leftovers(process.pid)


@pytest.mark.check
def test_interrupt_leaves_a_report_and_no_process(files: Prepared, tmp_path: Path) -> None:
    out = tmp_path / "run"
    process = start("latency", *files.arguments, "--duration", "60", "--load", "1", "--out", out)
    until(lambda: _observing(out), "time observed")
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.returncode == 130, done.stderr
    assert json.loads((out / "latency.json").read_text())["ticks"] > 0
    until(lambda: not _with_parent(process.pid), "children ended", 20.0)


@pytest.mark.check
def test_killed_measurement_takes_its_children_along(files: Prepared, tmp_path: Path) -> None:
    """The busy processes above all."""
    out = tmp_path / "run"
    process = start("latency", *files.arguments, "--duration", "60", "--load", "2", "--out", out)
    until(lambda: _observing(out), "time observed")
    assert len(_with_parent(process.pid)) == 7
    process.kill()
    finish(process)
    until(lambda: not _with_parent(process.pid), "children ended", 20.0)


def test_what_is_not_ready_in_time_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(beside, "_READY_S", 0.0)
    with running_beside(tmp_path, tmp_path, 0, RealtimeSettings(), 50.0, 5) as begin_at:
        begin_at(time.monotonic_ns())
    assert read_bare_loop(tmp_path, tmp_path, 50.0) is None
    assert read_round_trips(tmp_path, 50.0) is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--endpoint", "tcp/127.0.0.1:7447"], "--attach"),
        (["--attach", "--weights", "w.bin"], "started here"),
        (["--attach", "--log", "run.mcap"], "leave out --attach"),
        (["--log", "run.mcap"], "no log at run.mcap"),
        (["--rate", "0"], "--rate"),
        (["--json", "/no/such/folder/x.json"], "no folder"),
        (["--track", "nowhere"], "nowhere"),
    ],
)
def test_bad_options_get_one_line(cli: Cli, arguments: list[str], words: str) -> None:
    refused(cli("latency", "--out", "run", *arguments), words)


@pytest.mark.parametrize("name", ["latency.json", "run.mcap"])
def test_a_measurement_is_never_overwritten(cli: Cli, tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    refused(cli("latency", "--out", tmp_path), "holds a measurement already")


# Attached --------------------------------------------------------------------------------------


@contextmanager
def _system(
    files: Prepared, folder: Path, prefix: Sequence[str] = ()
) -> Iterator[tuple[list[str], Director]]:
    """A system, its plant started by ``prefix``: its endpoints and its director."""
    plant, controller, name = free_endpoint(), free_endpoint(), ("--name", "other")
    drive = (*files.arguments, "--weights", str(files.weights), "--endpoint", plant)
    with (
        Program(folder / "plant.txt", "plant", "--endpoint", plant, *name, prefix=prefix),
        Program(folder / "controller.txt", "controller", *drive, "--listen", controller, *name),
        open_session(Endpoints(connect=(plant, controller))) as session,
    ):
        director = Director(session, "other")
        director.wait_for(("plant", "controller"), 60.0)
        yield [plant, controller], director


def _attached(endpoints: list[str], director: Director, track: Track, out: Path) -> dict[str, Any]:
    """A measurement that begins before the run does."""
    ends = [word for endpoint in endpoints for word in ("--endpoint", endpoint)]
    process = start(
        "latency", "--attach", *ends, "--name", "other", "--duration", "2", "--out", out
    )
    assert process.stdout is not None
    assert any("wait for a run" in line for line in process.stdout), finish(process).stderr
    director.start(run_request(track, RunPlan(1, "test", 0, 1e5, lockstep=False)))
    done = finish(process)
    assert done.returncode == 0, done.stderr
    content: dict[str, Any] = json.loads((out / "latency.json").read_text())
    return content


@pytest.mark.check
def test_a_running_system_is_measured_and_left_running(files: Prepared, tmp_path: Path) -> None:
    with _system(files, tmp_path) as (endpoints, director):
        result = _attached(endpoints, director, files.first.track, tmp_path / "run")
        assert director.status("plant").phase == "running"
        until(lambda: director.status("controller").phase == "driving", "driven, as before")
    assert result["attached"] is True
    assert result["clocks"]["shared"] is True
    assert set(result["legs_us"]) == set(LEGS)
    assert result["rss_growth_bytes"] is None
    assert result["off_track_samples"] is None
    assert result["ticks"] > 10  # of a hundred on a machine that keeps up


def test_nothing_to_attach_to_is_an_error(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    patient = Director.wait_for
    monkeypatch.setattr(Director, "wait_for", lambda self, whom, _: patient(self, whom, 0.3))
    outcome = cli("latency", "--attach", "--endpoint", free_endpoint(), "--out", "run")
    refused(outcome, "no controller and no plant")


def test_a_run_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a run for so long, that is said."""
    phases = iter(["idle", "running", "running", "idle"])
    rates = iter([50.0, 0.0, 50.0, 50.0])  # none in lockstep
    director: Any = SimpleNamespace(
        status=lambda name: (
            SimpleNamespace(phase=next(phases))
            if name == "plant"
            else SimpleNamespace(rate_hz=next(rates))
        )
    )
    _wait_for_run(director, "orca")
    monkeypatch.setattr("bayesrace.studies.latency.measure._RUN_S", 0.0)
    with pytest.raises(InputError, match=r"plant: idle.*bayesrace drive --mode realtime"):
        _wait_for_run(director, "orca")


def _time_namespaces() -> str:
    """Why a process cannot be given another monotonic clock here, or ""."""
    try:
        done = subprocess.run(
            ["unshare", "--time", "--monotonic=1000", "--fork", sys.executable, "-c", ""],
            capture_output=True, text=True, timeout=30, check=False,
        )  # fmt: skip
    except OSError as error:
        return f"no unshare: {error}"
    return done.stderr.strip()[:200] if done.returncode else ""


@pytest.mark.check
def test_clock_of_another_host_is_found_and_corrected(files: Prepared, tmp_path: Path) -> None:
    """The plant in a time namespace: its monotonic clock is 1000 s ahead of all others."""
    if why_not := _time_namespaces():
        pytest.skip(f"time namespaces are not allowed here: {why_not}")
    prefix = ["unshare", "--time", "--monotonic=1000", "--fork", "--kill-child"]
    with _system(files, tmp_path, prefix) as (endpoints, director):
        result = _attached(endpoints, director, files.first.track, tmp_path / "run")
    clocks = result["clocks"]
    assert clocks["shared"] is False
    assert abs(clocks["offset_us"] + 1e9) <= clocks["uncertainty_us"]
    assert clocks["exchanges"] > 10  # of a hundred on a machine that keeps up
    margin_us = clocks["uncertainty_us"]
    assert 0 < margin_us < 1e5
    for name in ("state_transport", "state_age", "actuation_transport"):
        leg = result["legs_us"][name]
        assert leg["uncertainty_us"] == margin_us
        assert -margin_us <= leg["min"]
        # A state that is answered again is older each time: its age has no bound in its answer.
        answer_us = 1e6 if name == "state_age" else result["state_to_actuation_us"]["p50"]
        assert leg["p50"] <= answer_us + margin_us, name
    for name in ("state_to_actuation", "feedback"):
        assert result["legs_us"][name]["uncertainty_us"] == 0
