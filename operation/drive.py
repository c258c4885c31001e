"""Directs one run of a waiting plant and controller, from the start line to the last lap."""

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.messages import EVENT, Event
from bayesrace.operation.analysis.laps import Verdict, judge_log
from bayesrace.operation.run_plan import RunPlan, announcement, run_request
from bayesrace.raceline import same_track
from bayesrace.recorder import Recorder
from bayesrace.scene import Scene
from bayesrace.tracks import Track
from bayesrace.transport import Director, Endpoints, Publisher, RefusedError, open_session
from bayesrace.vehicles import Car, car_text

__all__ = ["drive_and_judge", "execute"]

_log = logging.getLogger("bayesrace.drive")

_ABSENCE_S = 10.0
"""In real time a process may be away for so long: a link comes back, a controller is started
again, and the car waits at standstill."""

_REGULAR = ("laps", "max_time", "left_world")
"""Ends of a run that the car's driving, not a fault, has brought about."""


def execute(
    director: Director,
    publisher: Publisher[Event],
    track: Track,
    plan: RunPlan,
    recorder: Recorder | None = None,
    paused: Callable[[Event], None] = lambda _: None,
    trouble: Callable[[], str] | None = None,
) -> Event:
    """Announces and starts the run and waits for its end; the plant's ``run_ended`` event.
    ``paused`` is called at each of its pauses. ``trouble``: a reason to abort the run; by default
    that the recorder fails.

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
            trouble or (lambda: recorder.failed if recorder else ""),
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
    endpoints: Endpoints,
    car: Car,
    name: str,
    track: Track,
    plan: RunPlan,
    log: Path,
    most_bytes: int | None = None,
) -> tuple[Event, Verdict]:
    """The next run, after those before, of the processes that wait, with a log: its end, and the
    verdict. ``name``: the car's in the network; ``most_bytes``: size of the log at most.

    Raises as :func:`execute`, but a log that cannot be written does not abort the run: a warning
    names it at once, and the InputError comes after the run's end.
    """
    endpoints.check_car(name)
    about = {"drive": {"car": car_text(car), "track": track.name}}
    scene = Scene(car, track, name=name)
    end: Event | None = None
    try:
        with (
            open_session(endpoints, "director") as session,
            Recorder(session, name, log, about, most_bytes, scene) as recorder,
        ):
            director = Director(session, name)
            director.wait_for(("plant", "controller"), 10.0)
            publisher: Publisher[Event] = Publisher(session, EVENT, name, "race")
            plan = replace(plan, run=director.status("plant").run + 1)
            end = execute(director, publisher, track, plan, trouble=_only_warned(recorder))
    except InputError as error:
        if end is None:
            raise
        raise InputError(f"{end.text}; not judged: {error}") from None
    return end, judge_log(log, plan.run, track, plan.laps)


def _only_warned(recorder: Recorder) -> Callable[[], str]:
    """Never a reason to abort a run; warns once when the log cannot be written any more."""
    warned = False

    def trouble() -> str:
        nonlocal warned
        if recorder.failed and not warned:
            warned = True
            _log.warning("%s; the run goes on without a log", recorder.failed)
        return ""

    return trouble


def _check_track(track: Track, controllers: str) -> None:
    """InputError if the controller says that it drives another track: no lap would be completed."""
    if controllers and not same_track(controllers, track.identity):
        raise InputError(
            f"the controller drives the track '{controllers}', this run is on '{track.identity}': "
            "name the controller's track here (--track), or start a controller with this one"
        )
