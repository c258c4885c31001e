"""Several real processes over loopback: what holds, and what happens when one of them is killed.

Promises guarded: two lockstep runs with one seed are identical to the byte; nothing is lost in
lockstep; a killed plant or controller and Ctrl-C end the run with a clear message, a readable log
and no process left over. All of it with the built-in car, and with an FMU in its place.
"""

import contextlib
import hashlib
import itertools
import json
import signal
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import ACTUATION, EVENT, GO_ON, STATE, TELEMETRY, Event, GoOnRequest
from bayesrace.recorder import Recorder
from bayesrace.transport import Endpoints, Inbox, ask, open_session
from tests.car_fmu import packed_car
from tests.driven import blank
from tests.programs import until
from tests.pursuit_rig import CONTROLLER, PATIENCE_S, PLANT, Rig, running_rig, start

# Drives well, with a plan, for a second; then raises, then gives no number.
FAILING = """
class Failing(PurePursuit):
    count = 0
    def step(self, x, u_previous, *others):
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


@pytest.fixture(
    scope="module", params=["built-in car", pytest.param("FMU", marks=pytest.mark.check)]
)
def simulated_by(request: pytest.FixtureRequest) -> dict[str, str]:
    """Plant settings that choose what simulates the car."""
    return {"fmu": str(packed_car())} if request.param == "FMU" else {}


@pytest.fixture(scope="module")
def rig(simulated_by: dict[str, str]) -> Iterator[Rig]:
    """For tests that leave both processes as they found them."""
    with running_rig(simulated_by) as rig:
        yield rig


@pytest.fixture
def mortal(simulated_by: dict[str, str]) -> Iterator[Rig]:
    """For tests that end one of the processes."""
    with running_rig(simulated_by) as rig:
        yield rig


def digest(log: Path) -> str:
    states = LogReader(log).select(STATE)
    rows = b"".join(struct.pack("<10d", s.time_s, *s.x, *s.u_applied) for s in states)
    return hashlib.sha256(rows).hexdigest()


def test_two_lockstep_runs_with_one_seed_are_identical(
    rig: Rig, simulated_by: dict[str, str], tmp_path: Path
) -> None:
    for run in (1, 2):
        end = rig.drive(tmp_path / f"{run}.mcap")
        assert end.data["reason"] == "laps", end.text
        assert end.data["rejected"] == end.data["refused"] == end.data["stale"] == 0
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "2.mcap")
    with running_rig(simulated_by) as other:
        other.drive(tmp_path / "3.mcap")
    assert digest(tmp_path / "1.mcap") == digest(tmp_path / "3.mcap")
    with running_rig(simulated_by, seed=2) as other:
        other.drive(tmp_path / "4.mcap")
    assert digest(tmp_path / "1.mcap") != digest(tmp_path / "4.mcap")


def test_the_log_of_a_lockstep_run_is_complete(rig: Rig, tmp_path: Path) -> None:
    end = rig.drive(tmp_path / "log.mcap")
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


def test_a_run_that_waits_for_its_director_goes_on_as_if_it_had_not(
    rig: Rig, tmp_path: Path
) -> None:
    """Also where it takes longer than the controller expects a state."""
    logs, waited_s = [], list[float]()

    def paused(event: Event) -> None:
        now_s = float(event.data["time_s"])
        waited_s.append(now_s)
        another = ask(rig.session, GO_ON, "orca", blank(GoOnRequest, run=run + 1))
        assert (another.accepted, another.text) == (False, f"none to go on: {event.text}")
        assert event.text == f"run {run} waits at {now_s:.2f} s"
        assert rig.director.status("plant").text.startswith(event.text)
        time.sleep(1.2 * (len(waited_s) == 2))

    for pause_s in (0.0, 0.5):
        log = tmp_path / f"{pause_s}.mcap"
        with Recorder(rig.session, "orca", log):
            rig.director.wait_for(("plant", "controller"), PATIENCE_S)
            run = rig.start(laps=0, max_time_s=1.9, pause_s=pause_s)
            assert rig.director.wait_for_end(run, 60.0, paused=paused).data["reason"] == "max_time"
        logs.append([(one.x, one.u_applied) for one in LogReader(log).select(STATE)])
    assert waited_s == pytest.approx([0.5, 1.0, 1.5])
    assert logs[0] == logs[1]


def test_a_run_that_waits_for_its_director_can_be_stopped(rig: Rig) -> None:
    run = rig.start(laps=0, pause_s=0.5)

    def paused(_: Event) -> None:
        assert rig.director.stop("enough").accepted

    end = rig.director.wait_for_end(run, 60.0, paused=paused)
    assert end.data["reason"] == "stopped"
    assert end.data["time_s"] == pytest.approx(0.5)


def test_a_run_in_real_time_does_not_wait_and_only_one_that_waits_goes_on(rig: Rig) -> None:
    text = rig.director.status("plant").text  # of the run before, or that there was none
    reply = ask(rig.session, GO_ON, "orca", blank(GoOnRequest, run=1))
    assert (reply.accepted, reply.text) == (False, f"none to go on: {text}")
    with pytest.raises(InputError, match="a run in real time does not wait: leave out pause_s"):
        rig.start(lockstep=False, laps=0, pause_s=0.5)


@pytest.mark.wall_clock
def test_free_running_drives_in_real_time(simulated_by: dict[str, str], tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    with (
        running_rig(simulated_by, low_latency=False) as rig,
        Recorder(rig.session, "orca", log) as seen,
    ):
        rig.director.wait_for(("plant", "controller"), PATIENCE_S)
        begin = time.monotonic()
        run = rig.start(lockstep=False, laps=0, max_time_s=1e5)
        driven = rig.spectator.wait_for(
            run, lambda state: np.hypot(state.x[0] - 2.0, state.x[1]) > 0.5, "half a metre"
        )
        assert 0.2 < driven.time_s < time.monotonic() - begin
        assert rig.director.stop("far enough").accepted
        end = rig.director.wait_for_end(run, PATIENCE_S)
    assert end.data["reason"] == "stopped"
    assert seen.counters.missing == 0, seen.gaps
    assert LogReader(log).select(STATE)[-1].time_s == end.data["time_s"]


def test_a_plant_for_lockstep_refuses_to_run_in_real_time(rig: Rig) -> None:
    with pytest.raises(InputError, match=r"started for lockstep \(--low-latency\)"):
        rig.start(lockstep=False)


def test_a_failing_step_goes_down_the_levels_and_the_car_stops(
    simulated_by: dict[str, str], tmp_path: Path
) -> None:
    code = CONTROLLER.replace("assert not", FAILING + "assert not")
    with running_rig(simulated_by, controller_code=code) as rig:
        end = rig.drive(tmp_path / "log.mcap", laps=0, max_time_s=4.0)
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


@pytest.mark.parametrize("waits", [False, True])
def test_a_killed_controller_ends_a_lockstep_run(mortal: Rig, tmp_path: Path, waits: bool) -> None:
    """Also one that waits for its director."""
    rig = mortal

    def killed(_: Event) -> None:
        rig.controller.kill()
        rig.wait_for_phase("plant", "idle")

    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        rig.director.wait_for(("plant",), PATIENCE_S)
        run = rig.start(laps=0, max_time_s=1e5, pause_s=0.5 * waits)
        if not waits:
            rig.wait_until_driving(run)
            rig.controller.kill()
        end = rig.director.wait_for_end(run, PATIENCE_S, absence_s=PATIENCE_S, paused=killed)
    assert end.data["reason"] == "controller_lost"
    assert "controller vanished" in end.text
    states = LogReader(tmp_path / "log.mcap").select(STATE)
    assert states
    assert states[-1].time_s == end.data["time_s"]
    with pytest.raises(InputError, match="no controller for car 'orca'"):
        rig.start()
    assert rig.director.status("plant").phase == "idle"


def test_a_killed_plant_is_noticed_by_everyone(mortal: Rig, tmp_path: Path) -> None:
    rig = mortal
    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        run = rig.start(laps=0, max_time_s=1e5)
        rig.wait_until_driving(run)
        rig.plant.kill()
        with pytest.raises(InputError, match=f"plant of car 'orca' vanished during run {run}"):
            rig.director.wait_for_end(run, PATIENCE_S)
    assert LogReader(tmp_path / "log.mcap").select(STATE)
    rig.wait_for_phase("controller", "waiting")
    assert "plant vanished" in rig.director.status("controller").text


def test_ctrl_c_ends_plant_and_run_cleanly(mortal: Rig, tmp_path: Path) -> None:
    rig = mortal
    with Recorder(rig.session, "orca", tmp_path / "log.mcap"):
        run = rig.start(laps=0, max_time_s=1e5)
        rig.wait_until_driving(run)
        for process in (rig.plant, rig.controller):
            process.send_signal(signal.SIGINT)
        rig.director.wait_for_end(run, PATIENCE_S, absence_s=PATIENCE_S)
        assert rig.plant.wait(PATIENCE_S) == 0
        assert rig.controller.wait(PATIENCE_S) == 0
    log = LogReader(tmp_path / "log.mcap")
    ends = [event for event in log.select(EVENT) if event.kind == "run_ended"]
    assert [event.data["reason"] for event in ends] in (["interrupted"], ["controller_lost"])


def test_a_run_is_stopped_on_request_and_another_refused_meanwhile(rig: Rig) -> None:
    run = rig.start(laps=0, max_time_s=1e5)
    with pytest.raises(InputError, match=f"busy: run {run} is running"):
        rig.start()
    assert rig.director.status("plant").phase == "running"
    assert rig.director.stop("enough").accepted
    end = rig.director.wait_for_end(run, PATIENCE_S)
    assert end.data["reason"] == "stopped"
    assert "enough" in end.text
    assert not rig.director.stop("again").accepted


def test_a_run_of_two_controllers_is_refused_or_no_success(rig: Rig) -> None:
    """Only the plant is connected to both: each would drive now and then."""

    def plant_sees(controllers: int) -> None:
        """The declaration travels, and so does its end."""
        until(
            lambda: len(rig.director.status("plant").seen) == controllers,
            f"the plant sees {controllers}",
            PATIENCE_S,
        )

    @contextlib.contextmanager
    def another() -> Iterator[None]:
        with open_session(Endpoints(connect=(rig.at_plant,), low_latency=True)) as session:
            kept = Inbox(session, "orca")
            kept.announce("controller")
            plant_sees(2)
            yield
        plant_sees(1)

    with another(), pytest.raises(InputError, match="2 controllers drive car 'orca'; end all but"):
        rig.start()
    run = rig.start(laps=10)
    with another():
        end = rig.director.wait_for_end(run, 60.0)
    assert end.data["reason"] == "several_controllers"
    assert "but 2 controllers drove the car" in end.text


def test_weights_for_a_controller_without_any_are_refused_with_a_reason(rig: Rig) -> None:
    before = int(rig.director.status("controller").counters["weights_refused"])
    with pytest.raises(InputError, match="this controller takes no weights while it drives"):
        rig.director.send_weights(bytes(200_000))
    assert rig.director.status("controller").counters["weights_refused"] == before + 1


@pytest.mark.parametrize("after_s", [0.0, 1.5])
def test_processes_do_not_outlive_their_starter(
    simulated_by: dict[str, str], after_s: float
) -> None:
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
    parent = start(starter, PLANT, json.dumps(simulated_by))
    assert parent.stdout is not None
    assert parent.stdout.readline().strip().isdigit()
    time.sleep(after_s)
    parent.kill()
    # returns when the child, which holds the pipe too, has ended
    parent.communicate(timeout=PATIENCE_S)
