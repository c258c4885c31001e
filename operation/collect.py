"""Training data: pure-pursuit drives of the car, logged as a race's drives are.

A racing line touches the edges of the track, and a driver that is disturbed on purpose, and slides,
leaves it there. So a drive follows the racing line where that leaves room to the edges, and else
a line made of it. Where it leaves the track or spins, the next one is slower there; elsewhere it
stays as fast, as a residual is known at the speeds only that were driven. Where that does not help,
the line is too fast everywhere, and so it is if the fallback has to brake often, because the car
was lost sight of. Where states are estimated drives that have failed are learned from as well: most
do, and up to there they were the fastest ones. Of exact states the last drive says enough, and what
a car does that slides off is a model's worst part to learn.

Far from the edges bends are tight, and no drive is as fast as a racing line is in its wide ones.
What is missing is driven in practice: laps of the same track, on its racing line, by the controller
with what it has learned so far.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Flags, Floats
from bayesrace.controller.interface import Controller
from bayesrace.controller.pure_pursuit import DrivingStyle, PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.log import LogWriter
from bayesrace.operation.closed_loop import ClosedLoop, Driven, Watch, built_in_car
from bayesrace.plant.car import End
from bayesrace.plant.vehicle import FmuFault, Vehicle
from bayesrace.raceline import RaceLine, RaceLineSettings, read_raceline_for
from bayesrace.raceline.friction import timed_line
from bayesrace.sensors import EXACT, Sensors
from bayesrace.tracks import Track, load_track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.vehicles import Car, car_text

__all__ = [
    "collect", "drive_length_s", "practise", "pursuit_controller", "room_beside", "slower_before",
    "training_line", "training_margin_m",
]  # fmt: skip

_ATTEMPTS: Final = 10
_SLOWER: Final = 0.85
"""Speed over that of the attempt before, where something went wrong ..."""
_BEFORE: Final = 7.0
"""... and before, for as long a way as so many times what the driver looks ahead; within as much
again the speed falls, and within ..."""
_AFTER: Final = 0.25
"""... this share of it, after the place, it rises again."""
_EVERYWHERE: Final = 0.93
"""Speed over that of the attempt before, where the car has to be slower everywhere."""
_FALLBACK: Final = 0.1
"""Share of the cycles that the fallback may drive; with more the car is too fast to be seen."""
_MOST: Final = 0.3
"""Of a track's width: the most that the line keeps from each edge."""
_LAPS: Final = 1.5
"""Of the line, flying: the least length of a drive, which begins at rest and is slower."""
_ESTIMATED: Final = 5.0
"""Times as long as the car's file says, all drives together, where states are estimated ..."""
_ESTIMATED_LAPS: Final = 3.0
"""... and so many flying laps at least."""
_WAVE: Final = 0.4
"""Amplitude of the weaving style, over the room that the line keeps ..."""
_WAVELENGTH: Final = 32.0
"""... and its wavelength in wheelbases."""
_FAILED: Final = End("stopped", "the car has left its track, or spins")
_THINNED: Final = 4
"""Points of the racing line to a node of a line made of it."""


def collect(
    track: Track,
    line: RaceLine,
    car: Car,
    artefact: Path,
    path: Path,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
    vehicle: Vehicle | None = None,
    sensors: Sensors = EXACT,
    delay_s: float = 0.0,
) -> list[Driven]:
    """Drives for ``duration_s``, again until a drive neither leaves the track nor spins, and logs
    this one at ``path``.

    Where states are estimated all drives are logged, as runs from the start line, each up to where
    it fails: ``duration_s`` is then that of all, or longer, as each is to pass the whole line.

    Each is slower than the one before, to the last of ten. With a ``speed_scale`` in ``settings``
    there is but one. ``sensors``, ``delay_s``: as in :class:`ClosedLoop`, the seed is that of
    ``settings``.

    The same settings give the same drives to the bit. ``artefact``: a controller built for the car,
    whose control cycle drives. ``vehicle``: what simulates the car; the built-in equations without.
    Raises FmuFault if it fails.
    """
    followed = training_line(track, line, car, settings.style)
    room_m, speeds = room_beside(track, followed), followed.vx_mps
    vehicle = vehicle or built_in_car(car)

    def pursuit() -> PurePursuit:
        return PurePursuit(car, followed.x_m, followed.y_m, speeds, settings, room_m=room_m)

    watch = _until_it_fails(track, car) if sensors.root else lambda _: None
    least_s = min(duration_s, _lap_length_s(car, line))
    slowed, driven, log = np.ones(len(speeds)), list[Driven](), None
    try:
        for _ in range(1 if settings.speed_scale else _ATTEMPTS):
            if log is None or not sensors.root:
                if log is not None:
                    log.close()
                log = _log_of(path, track, car)
                controller, driven = PythonController(artefact, pursuit()), []
                loop = ClosedLoop(
                    car, track, line, controller, vehicle, log,
                    sensors=sensors, seed=settings.seed, delay_s=delay_s,
                )  # fmt: skip
            else:
                controller.law = pursuit()
            left_s = max(duration_s - sum(float(one.time_s[-1]) for one in driven), least_s)
            one = loop.drive(0, left_s, start_speed_mps, name="pure-pursuit", watch=watch)
            driven.append(one)
            if one.end.reason == "plant_fault":
                raise FmuFault(one.end.text)
            slower, everywhere = _slower_after(one, followed, slowed)
            if everywhere == 1 and slower.min() == 1:
                break
            slowed, speeds = slower * slowed, everywhere * slower * speeds
    finally:
        if log is not None:
            log.close()
    return driven


def practise(
    track: Track,
    line: RaceLine,
    car: Car,
    controller: Controller,
    path: Path,
    laps: int,
    seed: int,
    start_speed_mps: float,
    vehicle: Vehicle,
    sensors: Sensors,
    delay_s: float,
) -> Driven:
    """Drives laps of a training track with the controller, logged at ``path``, up to where the car
    leaves the track or spins.

    ``vehicle``, ``sensors``, ``seed``, ``delay_s``: as in :class:`ClosedLoop`. Raises FmuFault if
    what simulates the car fails.
    """
    log = _log_of(path, track, car)
    try:
        loop = ClosedLoop(
            car, track, line, controller, vehicle, log,
            sensors=sensors, seed=seed, delay_s=delay_s,
        )  # fmt: skip
        watch = _until_it_fails(track, car)
        driven = loop.drive(laps, start_speed_mps=start_speed_mps, name="practice", watch=watch)
    finally:
        log.close()
    if driven.end.reason == "plant_fault":
        raise FmuFault(driven.end.text)
    return driven


def _log_of(path: Path, track: Track, car: Car) -> LogWriter:
    """Names the car, so that what is learned from the log is learned of this one."""
    return LogWriter(path, {"collect": {"track": track.name, "car": car_text(car)}})


def _until_it_fails(track: Track, car: Car) -> Watch:
    """Ends a drive where the true car leaves the track or spins."""
    return lambda x: _FAILED if _failing(track, car, np.array([x]))[0] else None


def _slower_after(one: Driven, line: RaceLine, slowed: Floats) -> tuple[Floats, float]:
    """Shares of the line's speeds, (n,), and of all of them, with which the next drive is slower
    than this one; ``slowed`` (n,): where it was slower than the first. Ones: it was good."""
    same = np.ones(len(slowed))
    lost = one.fallbacks > _FALLBACK * len(one.levels)
    wrong = _failing(one.track, one.car, one.x)
    if wrong.any():  # the first time: what comes after it may follow of it
        at = one.x[int(np.argmax(wrong))]
        if slowed[_nearest(line, at)] == 1:
            return slower_before(line, at, one.car), _EVERYWHERE if lost else 1.0
    return same, _EVERYWHERE if lost or wrong.any() else 1.0


def _failing(track: Track, car: Car, x: Floats) -> Flags:
    """Which of the states (n, 7) are off the track, or those of a spin."""
    moving = np.hypot(x[:, 3], x[:, 4]) > car.tuning.gate.moving_mps
    spinning = np.abs(np.arctan2(x[:, 4], x[:, 3])) > car.tuning.gate.spin_rad
    return np.asarray((track.project_path(x[:, :2]).off_track_m > 0) | (moving & spinning))


def _nearest(line: RaceLine, x: Floats) -> int:
    """The point of the line that is nearest to the state."""
    return int(np.argmin(np.sum((line.xy_m - x[:2]) ** 2, axis=1)))


def slower_before(line: RaceLine, x: Floats, car: Car) -> Floats:
    """Shares of the line's speeds, (n,), by which the car is to be slower before the state ``x``
    (7,)."""
    begin = _nearest(line, x)
    way_m = _BEFORE * car.tuning.pursuit.preview_s * max(float(x[3]), float(line.vx_mps.min()))
    way_m = min(way_m, line.length_m / (2 + _AFTER))
    before_m = (line.s_m[begin] - line.s_m) % line.length_m
    rising = np.clip(1 - (line.length_m - before_m) / (_AFTER * way_m), 0, 1)
    falling = np.clip(2 - before_m / way_m, 0, 1)
    return np.asarray(1 - (1 - _SLOWER) * np.maximum(falling, rising))


def pursuit_controller(
    artefact: Path,
    car: Car,
    track: str,
    raceline: Path,
    speed_scale: float,
    step_s: float,
) -> PythonController:
    """Pure pursuit in place of the compiled controller, along what a training drive follows.

    ``speed_scale``: mean share of the line's speed; ``step_s``: period of the control cycle.
    """
    course = load_track(track, car.width_m)
    line = training_line(course, read_raceline_for(raceline, course, car), car, "calm")
    settings = PurePursuitSettings(style="calm", speed_scale=speed_scale, step_s=step_s)
    law = PurePursuit(
        car, line.x_m, line.y_m, line.vx_mps, settings, room_m=room_beside(course, line)
    )
    return PythonController(artefact, law, course.identity)


def training_margin_m(track: Track, car: Car, margin_m: float | None = None) -> float:
    """Margin of a racing line that is made for a training drive; no less than ``margin_m``."""
    narrowest_m = float(np.min(track.width_right_m + track.width_left_m))
    room_m = min(car.tuning.pursuit.keep_m, _MOST * narrowest_m)
    return max(room_m, car.width_m / 2 if margin_m is None else margin_m)


def drive_length_s(car: Car, line: RaceLine, sensors: Sensors = EXACT) -> float:
    """Length of training drives along a line, by default: a lap at least; longer where states are
    estimated, as such a sample says less."""
    if not sensors.root:
        return _lap_length_s(car, line)
    return max(_ESTIMATED * car.tuning.pursuit.drive_s, _ESTIMATED_LAPS * line.lap_time_s)


def _lap_length_s(car: Car, line: RaceLine) -> float:
    """Length of a drive that passes all of a line."""
    return max(car.tuning.pursuit.drive_s, _LAPS * line.lap_time_s)


def training_line(track: Track, line: RaceLine, car: Car, style: DrivingStyle) -> RaceLine:
    """What a training drive follows: a racing line; where that is too near to the edges, the same
    moved inwards; or one that weaves about it. No faster than friction and the given line allow.
    """
    near = track.project_path(line.xy_m)
    keep_m = training_margin_m(track, car)
    if -float(near.off_track_m.max()) < 0.95 * keep_m:
        right, left = track.widths(near.s_m)
        middle, half = (left - right) / 2, (left + right) / 2
        outermost = float((np.abs(near.n_m - middle) / half).max())
        share = (1 - keep_m / float(half.min())) / outermost
        line = _moved(track, line, car, (share - 1) * (near.n_m - middle))
    if style == "weave":
        waves = max(1, round(line.length_m / (_WAVELENGTH * car.wheelbase_m)))
        phase = 2 * np.pi * waves * line.s_m / line.length_m
        line = _moved(track, line, car, _WAVE * keep_m * np.sin(phase))
    return line


def room_beside(track: Track, line: RaceLine) -> tuple[Floats, Floats]:
    """Distances from the line's points to the right and to the left edge, (n,) each [m]."""
    near = track.project_path(line.xy_m)
    right, left = track.widths(near.s_m)
    return right + near.n_m, left - near.n_m


def _moved(track: Track, line: RaceLine, car: Car, by_m: Floats) -> RaceLine:
    """The line moved to the left by so much at each point (n,), with speeds for its bends."""
    normal = track.normal(track.project_path(line.xy_m).s_m)
    path = fit_arc_length((line.xy_m + by_m[:, None] * normal)[::_THINNED])
    moved = timed_line(track.name, path, car, RaceLineSettings())
    beside, s = (track.project_path(one.xy_m).s_m for one in (line, moved))
    order = np.argsort(beside)
    speeds = np.interp(s, beside[order], line.vx_mps[order], period=track.length_m)
    return replace(moved, vx_mps=np.minimum(moved.vx_mps, speeds))
