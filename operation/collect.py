"""Training data: a pure-pursuit drive of the car, logged as a race's drives are.

A racing line touches the edges of the track, and a driver that is disturbed on purpose, and slides,
leaves it there. So the drive follows the racing line where that leaves room to the edges, and else
a line made of it. A drive that leaves the track or spins is driven again, slower where it did;
elsewhere it stays as fast, as a residual is known at the speeds only that were driven. Where that
does not help, the line is too fast everywhere, and so it is if the fallback has to brake often,
because the car was lost sight of.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.pure_pursuit import DrivingStyle, PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.log import LogWriter
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.plant.vehicle import FmuFault, Vehicle
from bayesrace.raceline import RaceLine, RaceLineSettings, read_raceline_for
from bayesrace.raceline.friction import timed_line
from bayesrace.sensors import EXACT, Sensors
from bayesrace.tracks import Track, load_track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.vehicles import CarParameters, car_text

__all__ = [
    "collect", "drive_length_s", "pursuit_controller", "room_beside", "slower_before",
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
_ESTIMATED: Final = 2.0
"""Times that length where states are estimated."""
_WAVE: Final = 0.4
"""Amplitude of the weaving style, over the room that the line keeps ..."""
_WAVELENGTH: Final = 32.0
"""... and its wavelength in wheelbases."""
_THINNED: Final = 4
"""Points of the racing line to a node of a line made of it."""


def collect(
    track: Track,
    line: RaceLine,
    car: CarParameters,
    artefact: Path,
    path: Path,
    duration_s: float,
    settings: PurePursuitSettings,
    start_speed_mps: float = 0.1,
    vehicle: Vehicle | None = None,
    sensors: Sensors = EXACT,
    delay_s: float = 0.0,
) -> Driven:
    """Drives for ``duration_s`` and logs the run at ``path``: the first that stays on the track,
    does not spin and is driven to its end, or the last. With a ``speed_scale`` in ``settings``
    there is but one.

    ``sensors``, ``delay_s``: as in :class:`ClosedLoop`, the seed is that of ``settings``.

    The same settings give the same drive to the bit. ``artefact``: a controller built for the car,
    whose control cycle drives. ``vehicle``: what simulates the car; the built-in equations without.
    Raises FmuFault if it fails.
    """
    followed = training_line(track, line, car, settings.style)
    room_m, vehicle = room_beside(track, followed), vehicle or built_in_car(car)
    speeds, slowed = followed.vx_mps, np.ones(len(followed.vx_mps))
    for attempt in range(1 if settings.speed_scale else _ATTEMPTS):
        pursuit = PurePursuit(car, followed.x_m, followed.y_m, speeds, settings, room_m=room_m)
        scale = settings.scale * float(np.mean(speeds / followed.vx_mps))
        about = {
            "track": track.name, "car": car_text(car),
            "attempts": str(attempt + 1), "speed_scale": f"{scale:.3g}",
        }  # fmt: skip
        log = LogWriter(path, {"collect": about})
        try:
            loop = ClosedLoop(
                car, track, line, PythonController(artefact, pursuit), vehicle, log,
                sensors=sensors, seed=settings.seed, delay_s=delay_s,
            )  # fmt: skip
            driven = loop.drive(0, duration_s, start_speed_mps, name="pure-pursuit")
        finally:
            log.close()
        if driven.end.reason == "plant_fault":
            raise FmuFault(driven.end.text)
        wrong = track.project_path(driven.x[:, :2]).off_track_m > 0
        wrong |= np.abs(driven.slip_rad) > car.tuning.gate.spin_rad
        everywhere = driven.fallbacks > _FALLBACK * len(driven.levels)
        if not wrong.any() and not everywhere:
            break
        slower = np.ones(len(speeds))
        if wrong.any():  # the first time: what comes after it may follow of it
            at = driven.x[int(np.argmax(wrong))]
            slower = slower_before(followed, at, car)
            if slowed[_nearest(followed, at)] < 1:
                everywhere, slower = True, np.ones(len(speeds))
        slowed = slower * slowed
        speeds = (_EVERYWHERE if everywhere else 1.0) * slower * speeds
    return driven


def _nearest(line: RaceLine, x: Floats) -> int:
    """The point of the line that is nearest to the state."""
    return int(np.argmin(np.sum((line.xy_m - x[:2]) ** 2, axis=1)))


def slower_before(line: RaceLine, x: Floats, car: CarParameters) -> Floats:
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
    car: CarParameters,
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
    controller = PythonController(artefact, law)
    controller.track = course.identity
    return controller


def training_margin_m(track: Track, car: CarParameters, margin_m: float | None = None) -> float:
    """Margin of a racing line that is made for a training drive; no less than ``margin_m``."""
    narrowest_m = float(np.min(track.width_right_m + track.width_left_m))
    room_m = min(car.tuning.pursuit.keep_m, _MOST * narrowest_m)
    return max(room_m, car.width_m / 2 if margin_m is None else margin_m)


def drive_length_s(car: CarParameters, line: RaceLine, sensors: Sensors = EXACT) -> float:
    """Length of a training drive along a line, by default: a lap at least; longer where states are
    estimated, as such a sample says less."""
    length_s = max(car.tuning.pursuit.drive_s, _LAPS * line.lap_time_s)
    return _ESTIMATED * length_s if sensors.root else length_s


def training_line(
    track: Track, line: RaceLine, car: CarParameters, style: DrivingStyle
) -> RaceLine:
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


def _moved(track: Track, line: RaceLine, car: CarParameters, by_m: Floats) -> RaceLine:
    """The line moved to the left by so much at each point (n,), with speeds for its bends."""
    normal = track.normal(track.project_path(line.xy_m).s_m)
    path = fit_arc_length((line.xy_m + by_m[:, None] * normal)[::_THINNED])
    moved = timed_line(track.name, path, car, RaceLineSettings())
    beside, s = (track.project_path(one.xy_m).s_m for one in (line, moved))
    order = np.argsort(beside)
    speeds = np.interp(s, beside[order], line.vx_mps[order], period=track.length_m)
    return replace(moved, vx_mps=np.minimum(moved.vx_mps, speeds))
