"""A plant process that an FMU drives: what the FMU does ends the run, and nothing but the run.

One plant and controller for all faults: the map sets the fault from the start state's yaw rate,
which this car forgets in its first step.
"""

import contextlib
import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.columns import LogColumns
from bayesrace.errors import InputError
from bayesrace.learning.sources import dataset_from_log
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import STATE, TELEMETRY, TRUTH, Truth, car_key, encode
from bayesrace.operation.analysis.recording import RUN_COLUMNS, runs_of
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from bayesrace.vehicles import get_car
from tests import programs
from tests.car_fmu import Version, packed_car
from tests.driven import state
from tests.faulty_fmu import Mode, faulty_fmu, faulty_library
from tests.programs import until
from tests.pursuit_rig import PATIENCE_S, PLANT, Rig, Spectator, request, running_rig, start

pytestmark = pytest.mark.wall_clock

AT_S = 0.4
"""When the faults strike."""

HANGS_S = 2.0
"""A step that takes longer hangs. More than a machine stalls, less than a request waits."""


FAULTS = {
    Mode.ABORT: r"crashed \(SIGABRT\); its last message: the engine is on fire",
    Mode.HANG: "did not answer within 2 s",
    Mode.NOT_A_NUMBER: "gave vx = nan",
    Mode.TERMINATE: "the FMU ended the simulation",
}
"""``test_fmu_host`` has the others."""


def write_map(path: Path, timeout_s: float) -> Path:
    """The fault comes from the start state's yaw rate."""
    path.write_text(
        f"[fmu]\ntimeout_s = {timeout_s}\n[parameters]\nat_s = {AT_S}\n"
        '[start]\nmode = { from = "omega", scale = 1.0 }\n'
    )
    return path


@pytest.fixture(scope="module")
def car_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return faulty_fmu(faulty_library(2), tmp_path_factory.mktemp("fmu") / "faulty.fmu")


@pytest.fixture(scope="module")
def simulated_by(car_fmu: Path) -> dict[str, str]:
    """Plant settings that choose what simulates the car."""
    map_ = write_map(car_fmu.with_name("map.toml"), HANGS_S)
    return {"fmu": str(car_fmu), "fmu_map": str(map_)}


@pytest.fixture(scope="module")
def rig(simulated_by: dict[str, str]) -> Iterator[Rig]:
    with running_rig(simulated_by) as rig:
        yield rig


@pytest.fixture(scope="module")
def wall_clock_rig(simulated_by: dict[str, str]) -> Iterator[Rig]:
    with running_rig(simulated_by, low_latency=False) as rig:
        yield rig


def with_fault(mode: Mode) -> dict[str, Any]:
    return {"x0": (2.0, 0.0, np.pi / 2, 0.1, 0.0, float(mode), 0.0)}


@pytest.mark.parametrize(
    ("mode", "lockstep"),
    [
        (Mode.ABORT, True),
        (Mode.HANG, False),
        pytest.param(Mode.NOT_A_NUMBER, True, marks=pytest.mark.check),
        pytest.param(Mode.TERMINATE, True, marks=pytest.mark.check),
        pytest.param(Mode.NOT_A_NUMBER, False, marks=pytest.mark.check),
    ],
)
def test_a_fault_ends_the_run_and_nothing_else(
    mode: Mode, lockstep: bool, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    rig: Rig = request.getfixturevalue("rig" if lockstep else "wall_clock_rig")
    log = tmp_path / "log.mcap"
    end = rig.drive(log, lockstep=lockstep, laps=0, **with_fault(mode))
    assert end.data["reason"] == "plant_fault"
    assert re.search(FAULTS[mode], end.text)
    reader = LogReader(log)
    assert not reader.truncated
    states = reader.select(STATE)
    before, last = states[-2:]
    assert last.final
    assert not before.final
    assert (last.seq, last.time_s, last.x) == (before.seq + 1, before.time_s, before.x)
    assert (last.u_applied, last.lap) == (before.u_applied, before.lap)
    assert last.time_s == end.data["time_s"] == pytest.approx(AT_S - 0.02)
    answered = {telemetry.state_seq for telemetry in reader.select(TELEMETRY)}
    assert last.seq not in answered
    status = rig.director.status("plant")
    assert status.phase == "idle"
    assert re.search(FAULTS[mode], status.text)
    rig.wait_for_phase("controller", "waiting")


def test_after_all_that_it_drives_a_lap(rig: Rig, tmp_path: Path) -> None:
    digests = []
    for log in (tmp_path / "1.mcap", tmp_path / "2.mcap"):
        end = rig.drive(log, **with_fault(Mode.GOOD))
        assert end.data["reason"] == "laps", end.text
        states = LogReader(log).select(STATE)
        digests.append([(state.time_s, state.x) for state in states])
    assert digests[0] == digests[1]
    assert rig.plant.poll() is None


def test_a_failed_start_is_a_refused_run(rig: Rig) -> None:
    with pytest.raises(InputError, match=r"while it was initialised: .*this car has no wheels"):
        rig.start(**with_fault(Mode.INIT_FAILS))
    assert rig.director.status("plant").phase == "idle"


def test_a_slow_fmu_counts_as_overruns(wall_clock_rig: Rig, tmp_path: Path) -> None:
    """60 ms for a period of 20 ms."""
    before = int(wall_clock_rig.director.status("plant").counters["overruns"])
    changes = with_fault(Mode.SLOW) | {"max_time_s": AT_S + 0.2}
    end = wall_clock_rig.drive(tmp_path / "log", lockstep=False, laps=0, **changes)
    assert end.data["reason"] == "max_time"
    assert int(end.data["overruns"]) - before >= 5


def worker_of(plant: int) -> tuple[int, Path]:
    """Process number and folder of what runs an FMU for that plant."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            folder = (entry / "cwd").readlink()
            if parent == plant and folder.name.startswith("bayesrace-held"):
                found.append((int(entry.name), folder))
    [worker] = found
    return worker


def lives(process: int) -> bool:
    with contextlib.suppress(OSError):
        return bool(Path(f"/proc/{process}/cmdline").read_bytes())  # a zombie has none
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
@pytest.mark.parametrize(
    "how",
    [
        signal.SIGKILL,
        *(pytest.param(how, marks=pytest.mark.check) for how in (signal.SIGTERM, signal.SIGINT)),
    ],
)
def test_nothing_outlives_the_plant(how: signal.Signals, car_fmu: Path, tmp_path: Path) -> None:
    """However it ends, and were the FMU hanging at that moment."""
    at_plant = free_endpoint()
    settings = {
        "endpoints": {"listen": [at_plant]},
        "parent_pid": os.getpid(),
        "fmu": str(car_fmu),
        "fmu_map": str(write_map(tmp_path / "map.toml", timeout_s=60.0)),
    }
    plant = start(PLANT, json.dumps(settings))
    with open_session(Endpoints(connect=(at_plant,))) as session:
        director, spectator = Director(session, "orca"), Spectator(session)
        director.wait_for(("plant",), PATIENCE_S)
        worker, folder = worker_of(plant.pid)
        mode = Mode.HANG if how is signal.SIGKILL else Mode.GOOD
        director.start(request(1, lockstep=False, laps=0, max_time_s=1e5, **with_fault(mode)))
        before_s = AT_S - 0.03  # the last state that a hanging one gives
        spectator.wait_for(1, lambda state: state.time_s > before_s, "the hang")
        plant.send_signal(how)
        plant.communicate(timeout=PATIENCE_S)
    until(lambda: not (folder.exists() or lives(worker)), "the end of all of it", PATIENCE_S)


@pytest.mark.parametrize("version", [2, 3])
def test_a_plant_that_has_not_driven_ends_without_an_error_of_the_fmu(version: Version) -> None:
    endpoint = free_endpoint()
    plant = programs.start("plant", "--fmu", packed_car(version), "--endpoint", endpoint)
    with open_session(Endpoints(connect=(endpoint,))) as session:
        Director(session, "orca").wait_for(("plant",), PATIENCE_S)
    plant.send_signal(signal.SIGINT)
    done = programs.finish(plant)
    assert done.returncode == 0
    assert "FMU error" not in done.stdout + done.stderr


def test_the_command_refuses_an_unusable_fmu_in_a_line_a_fault(
    car_fmu: Path, tmp_path: Path
) -> None:
    map_ = tmp_path / "map.toml"
    map_.write_text('[outputs]\nvx = { variable = "speed" }\n')
    foreign = faulty_fmu(faulty_library(2), tmp_path / "foreign.fmu", platform="win64")
    cases: tuple[tuple[tuple[str | Path, ...], str, int], ...] = (
        (("--fmu", foreign), "is for win64", 1),
        (("--fmu", car_fmu, "--map", map_), "\n  - [outputs] vx: ", 3),
        (("--map", map_), "without an FMU", 1),
    )
    plants = [programs.start("plant", *options) for options, _, _ in cases]
    for plant, (_, why, lines) in zip(plants, cases, strict=True):
        done = programs.finish(plant)
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == lines
        assert why in done.stderr


def test_a_repeated_last_state_is_no_gap_and_no_sample(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "log.mcap")
    for seq, time_s in enumerate((0.0, 0.02, 0.04, 0.04)):
        x = np.array([0.02 * seq, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        one = state(1, seq, x, np.array([0.1, 0.0]), time_s=time_s, final=seq == 3)
        sample = Truth(**{name: getattr(one, name) for name in Truth.__struct_fields__})
        for topic, message in ((STATE, one), (TRUTH, sample)):
            log.write(car_key(topic.key, "orca"), encode(message), seq)
    log.close()
    record = runs_of(LogColumns(tmp_path / "log.mcap", RUN_COLUMNS).read())[1]
    assert record.states["seq"].tolist() == record.truth["seq"].tolist() == [0, 1, 2]
    assert record.gaps == 0
    data = dataset_from_log(tmp_path / "log.mcap", get_car("orca"), 0.02)
    assert (len(data), data.dropped.get("gap", 0)) == (2, 0)
