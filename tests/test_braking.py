"""Whatever is lost at racing speed, the car stops on its track: the controller sends its braking
plan ahead and the car's guard carries it out; without states the controller itself brakes along the
line, by the prediction.
"""

import math
import os
import signal
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bayesrace.controller.driver import Level
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import TRUTH, BrakingPlan, State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.host import HostProgram
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.system import started_system
from bayesrace.plant.car import End
from bayesrace.plant.vehicle import planned_at
from bayesrace.recorder import Recorder
from tests.exchanged import racing_host
from tests.network.cars import free_port, started_host
from tests.racing import Racing, prepared, racing
from tests.recovery import bridge_command
from tests.reference import reference_file

__all__ = ["racing_host"]  # a fixture

CUT_S = 0.4
"""A drive that starts at speed has found its line by then."""
STEP_S = 0.02
MOMENTS = 20


@pytest.fixture(scope="module", params=["harbour", pytest.param("ethz", marks=pytest.mark.check)])
def race(request: pytest.FixtureRequest) -> Racing:
    if request.param == "harbour":
        return racing()
    track, train = (reference_file(f"tracks/{name}.csv") for name in ("ethz", "ethzmobil"))
    return racing(str(track), str(train))


class Cut(ClosedLoop):
    """A car whose controller is gone from a moment on; only what it has sent before is left."""

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        if state.time_s < CUT_S - 1e-9:
            answer = super()._exchange(state, x)
            self.plan, output = self._cycle.driver.braking(0), self._cycle.driver.output
            if output is not None:
                self.planned = output.plan_x[:5].copy(), output.plan_u[:5].copy()
            return answer
        self._true_x.append(x)
        self._states.append(state)
        return planned_at(self.plan, state.time_s)  # type: ignore[return-value]


class Silent(ClosedLoop):
    """A car whose controller gets no states from a moment on."""

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        if state.time_s < CUT_S - 1e-9:
            return super()._exchange(state, x)
        self._true_x.append(x)
        self._states.append(state)
        decision = self._cycle.driver.decide(state.time_s)
        self.decided = decision.status, decision.level
        return decision.d, decision.delta_rate


@pytest.mark.parametrize("loss", [Cut, Silent])
def test_a_car_that_is_cut_off_stops_on_its_track(race: Racing, loss: type[ClosedLoop]) -> None:
    deepest = []
    for start in race.moments(MOMENTS):
        loop = loss(race.car, race.track, race.line, race.controller())
        driven = loop.drive(0, max_time_s=CUT_S + 3.2, x0=start)
        assert abs(driven.x[-1, 3]) < 0.02
        deepest.append(race.off_track_m(driven.x))
    assert max(deepest) <= 0
    if loss is Silent:
        assert loop.decided == (Status.NO_STATE, Level.STOP)  # type: ignore[attr-defined]


def test_the_plan_begins_with_what_would_be_driven_anyway(race: Racing) -> None:
    """A message that is lost or late costs nothing."""
    loop = Cut(race.car, race.track, race.line, race.controller())
    loop.drive(0, max_time_s=CUT_S, x0=race.moments(4)[2])
    plan, (x, u) = loop.plan, loop.planned
    assert plan is not None
    assert plan.begins_s == pytest.approx(CUT_S - STEP_S)
    assert plan.step_s == STEP_S
    np.testing.assert_allclose(plan.d[:5], u[:, 0], atol=1e-5)
    np.testing.assert_allclose(plan.delta[:4], x[1:, 6], atol=1e-5)
    assert plan.d[5] == pytest.approx(race.car.d_min)


def test_a_halted_car_needs_no_plan(race: Racing) -> None:
    loop = Cut(race.car, race.track, race.line, race.controller())
    loop._cycle.driver.stop()
    x, y, psi = race.track.start_pose()
    loop.drive(0, max_time_s=CUT_S, x0=(x, y, psi, 0, 0, 0, 0))
    assert loop.plan is None


def test_a_plan_is_followed_whenever_it_takes_over() -> None:
    """By steering angles, between its rows, too; not before it begins nor after it is over."""
    rows: tuple[float, ...] = (0.1, 0.2, 0.3)
    plan = BrakingPlan(
        seq=0, source_time_ns=0, epoch=1, run=1, begins_s=1.0, step_s=0.02, d=(0.5, -0.1, -0.2),
        delta=rows,
    )  # fmt: skip
    first, later = planned_at(plan, 1.0), planned_at(plan, 1.03)
    assert first is not None
    assert later is not None
    assert first.command(0.0, 0.02) == pytest.approx((0.5, 5.0))
    assert later.command(0.2, 0.01) == pytest.approx((-0.1, 0.0))
    assert later.command(0.0, 0.02) == pytest.approx((-0.1, 12.5))
    assert planned_at(plan, 0.9) is planned_at(plan, 1.061) is planned_at(None, 1.0) is None


# Real processes ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loss:
    """What became of a car whose controller was lost at racing speed."""

    before_m: float
    """How far off the track the car was before; a machine that stalls drives it off."""
    after_m: float
    """The same while the braking plan drove and the car stood, ..."""
    again_m: float
    """... and after a paused controller went on; minus infinity if it was not paused."""
    planned: int
    stood_mps: float
    end_mps: float


def lose(out: Path, what: signal.Signals | None, after_s: float, host: HostProgram | None) -> Loss:
    """One drive on harbour; a controller that is only paused goes on after 3 s.

    Without a signal the director of a held run is lost, whose loop goes round no more. ``host``:
    the controller without Python; it alone gets the signal, not its bridge.
    """
    files, car = prepared(), "orca"
    track = files.first.track
    with ExitStack() as stack:
        own, link = {}, f"udp:127.0.0.1:{free_port()}"
        if host is not None:
            program = stack.enter_context(started_host(host, link))
            own["controller"] = bridge_command(link, files.first.track_file, out)
        system = stack.enter_context(started_system(car, out, own=own))
        controllers = stack.enter_context(ExitStack())
        controllers.enter_context(system.controller(files.arguments))
        with Recorder(system.session, car, out / "run.mcap"):
            plan = RunPlan(1, "bayesrace", 1, 60.0, lockstep=False, held=what is None)
            request = msgspec.structs.replace(run_request(track, plan), laps=0)
            system.director.start(request)
            pid = system.children["controller"].pid if host is None else program.pid
            if what is None:
                with pytest.raises(InputError, match="did not end"):
                    system.director.wait_for_end(1, after_s)
            else:
                time.sleep(after_s)
                os.kill(pid, what)
            since_ns = time.monotonic_ns()
            time.sleep(3.0)
            stood_ns = time.monotonic_ns()
            if what == signal.SIGSTOP:
                os.kill(pid, signal.SIGCONT)
                time.sleep(4.0)
            counters = system.director.status("plant").counters
            system.director.stop("the test is over")
        controllers.pop_all()
    truth = LogReader(out / "run.mcap").select(TRUTH)
    off_m = track.project_path(np.array([one.x[:2] for one in truth])).off_track_m
    sent_ns = np.array([one.source_time_ns for one in truth])
    braked, again = (sent_ns > since_ns) & (sent_ns < stood_ns), sent_ns >= stood_ns
    paused = what == signal.SIGSTOP
    return Loss(
        before_m=float(off_m[sent_ns <= since_ns].max()),
        after_m=float(off_m[braked].max()),
        again_m=float(off_m[again].max()) if paused else -math.inf,
        planned=int(str(counters["planned"])),
        stood_mps=abs([one.x[3] for one in truth if one.source_time_ns < stood_ns][-1]),
        end_mps=truth[-1].x[3],
    )


LOSSES = (signal.SIGKILL, signal.SIGHUP, signal.SIGSTOP, None)
MOMENTS_S = (9.0, 10.7, 12.4)


@pytest.mark.check
@pytest.mark.wall_clock
@pytest.mark.parametrize(
    ("language", "what", "after_s"),
    [("Python", what, after_s) for what in LOSSES for after_s in MOMENTS_S]
    + [("C", what, after_s) for what, after_s in zip(LOSSES[::-1], MOMENTS_S, strict=False)],
)
def test_a_controller_or_director_that_is_lost_at_racing_speed(
    tmp_path: Path, language: str, what: signal.Signals | None, after_s: float,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    """A controller killed, its terminal closed, or paused for 3 s, after which it drives on; the
    director of a held run, for good."""
    host = request.getfixturevalue("racing_host") if language == "C" else None
    for attempt in range(3):
        out = tmp_path / str(attempt)
        out.mkdir()
        loss = lose(out, what, after_s, host)
        if loss.before_m <= 0 and loss.again_m <= 0:
            break
        assert loss.after_m <= 0 or loss.before_m > 0
    if loss.before_m > 0:
        pytest.skip("the machine stalls: the car left its track before the controller was lost")
    assert loss.planned > 20
    assert max(loss.after_m, loss.again_m) <= 0
    assert loss.stood_mps < 0.02
    if what == signal.SIGSTOP:
        assert loss.end_mps > 0.5
