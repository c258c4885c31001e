"""Directs one run of a waiting plant and controller, from the start line to the last lap."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.messages import EVENT, Event, RunRequest, Scalar
from bayesrace.operation.analysis.laps import Verdict, judge_log
from bayesrace.raceline import same_track
from bayesrace.recorder import Recorder
from bayesrace.tracks import StartLine, Track
from bayesrace.transport import Director, Endpoints, Publisher, RefusedError, open_session
from bayesrace.vehicles import Car, car_text

__all__ = ["RunPlan", "announcement", "drive_and_judge", "execute", "run_request"]

_ABSENCE_S = 10.0
"""In real time a process may be away for so long: a link comes back, a controller is started
again, and the car waits at standstill."""

_REGULAR = ("laps", "max_time", "left_world")
"""Ends of a run that the car's driving, not a fault, has brought about."""


@dataclass(frozen=True)
class RunPlan:
    """One run: its number in all messages, its controller, its length."""

    run: int
    controller: str
    laps: int
    max_time_s: float
    lockstep: bool
    start_speed_mps: float = 0.1
    held: bool = False
    """The car stops unless the director is heard all the time; in real time only."""
    exact: bool = False
    """The state is known as it is, whatever the sensors."""
    pause_s: float = 0.0
    """In lockstep: after each such time the run waits, see :class:`.RunRequest`; 0: never."""


def run_request(track: Track, plan: RunPlan) -> RunRequest:
    """What the plant needs to know: the start state and the start line, not the track."""
    x, y, psi = track.start_pose()
    line = StartLine(track)
    return RunRequest(
        seq=0,
        source_time_ns=time.monotonic_ns(),
        run=plan.run,
        lockstep=plan.lockstep,
        x0=(x, y, psi, plan.start_speed_mps, 0.0, 0.0, 0.0),
        line_x_m=x,
        line_y_m=y,
        line_heading_rad=psi,
        line_left_m=line.left_m,
        line_right_m=line.right_m,
        laps=plan.laps,
        max_time_s=plan.max_time_s,
        actuation_timeout_s=5.0 if plan.lockstep else 0.2,
        held=plan.held,
        exact=plan.exact,
        pause_s=plan.pause_s,
    )


def announcement(plan: RunPlan, seq: int, weights_version: str, refused: str = "") -> Event:
    """The event in the log before a run, which names its controller.

    ``refused``: why the controller refuses its weights, so that no run follows.
    """
    text = f"run {plan.run}: {plan.controller}" + (", weights refused" if refused else "")
    data: dict[str, Scalar] = {
        "run": plan.run,
        "controller": plan.controller,
        "weights_version": weights_version,
        "refused": refused,
    }
    return Event(
        seq=seq,
        source_time_ns=time.monotonic_ns(),
        run=plan.run,
        source="race",
        kind="run",
        text=text,
        data=data,
    )


def execute(
    director: Director,
    publisher: Publisher[Event],
    track: Track,
    plan: RunPlan,
    recorder: Recorder | None = None,
    paused: Callable[[Event], None] = lambda _: None,
) -> Event:
    """Announces and starts the run and waits for its end; the plant's ``run_ended`` event.
    ``paused`` is called at each of its pauses.

    How the car was driven is for :func:`bayesrace.operation.analysis.laps.judge`. InputError if
    the controller drives another track, the plant refuses, the recorder fails, or the run ended by
    anything but its laps, its time limit or the car's leaving the world, or several plants or
    controllers of one name are there, before or after; KeyboardInterrupt on a signal.
    """
    director.check_alone()
    controller = director.status("controller")
    _check_track(track, controller.track)
    announced = announcement(plan, publisher.next_seq, controller.weights_version)
    publisher.put(announced, lockstep=True)
    started = False
    try:
        director.start(run_request(track, plan))
        started = True
        # In lockstep simulated time passes faster than real time, but that is no promise.
        absence_s = 1.0 if plan.lockstep else _ABSENCE_S
        end = director.wait_for_end(
            plan.run,
            30.0 + 3.0 * plan.max_time_s,
            absence_s,
            lambda: recorder.failed if recorder else "",
            paused,
        )
    except BaseException as error:  # a car must not drive on unwatched
        # A plant that has refused may be driving for another director.
        if started or not isinstance(error, RefusedError):
            with suppress(InputError):
                director.stop("the process that started the run has ended")
        raise
    if end.data.get("reason") not in _REGULAR:
        raise InputError(f"run {plan.run} ({plan.controller}) ended early: {end.text}")
    director.check_alone()
    return end


def drive_and_judge(
    endpoints: Endpoints, car: Car, name: str, track: Track, plan: RunPlan, log: Path
) -> tuple[Event, Verdict]:
    """The next run, after those before, of the processes that wait, with a log: its end, and the
    verdict. ``name``: the car's in the network. Raises as :func:`execute`."""
    endpoints.check_car(name)
    about = {"drive": {"car": car_text(car), "track": track.name}}
    with (
        open_session(endpoints, "director") as session,
        Recorder(session, name, log, about) as recorder,
    ):
        director = Director(session, name)
        director.wait_for(("plant", "controller"), 10.0)
        publisher: Publisher[Event] = Publisher(session, EVENT, name, "race")
        plan = replace(plan, run=director.status("plant").run + 1)
        end = execute(director, publisher, track, plan, recorder)
    return end, judge_log(log, plan.run, track, plan.laps)


def _check_track(track: Track, controllers: str) -> None:
    """InputError if the controller says that it drives another track: no lap would be completed."""
    if controllers and not same_track(controllers, track.identity):
        raise InputError(
            f"the controller drives the track '{controllers}', this run is on '{track.identity}': "
            "name the controller's track here (--track), or start a controller with this one"
        )
