"""The racing line under the published objective: by Bayesian optimisation, and the direct method.

The objective is that of Jain and Morari (2020) as their program has it: nodes at their points of
the centreline, offsets over 95 % of the width, the path from the start point, at rest and on the
centreline, past the end of the lap to the first node, on the centreline; friction 1, drive force
mu m g lf / (lf + lr). Speeds are computed every centimetre, where theirs have 100 points in all:
the published line of ETHZ takes 7.046 s with theirs, 7.08 s here.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from bayesrace.arrays import Floats
from bayesrace.raceline import RaceLineSettings
from bayesrace.raceline.frame import Frame, frame_at, smooth_centreline
from bayesrace.raceline.guess import speed_profile
from bayesrace.raceline.ocp import car_limits, optimise
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import CarParameters, get_car
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor

__all__ = ["PUBLISHED", "direct", "objective", "open_frame", "path_time", "unlimited_car"]

_STEP_M: Final = 0.01
_SHARE: Final = 0.95
_REST_MPS: Final = 1e-3


class Published(NamedTuple):
    """Nodes as points of the track's file, and lap times after 110 evaluations, mean / best [s]."""

    nodes: tuple[int, ...]
    random: str
    improvement: str
    noisy: str


PUBLISHED: Final = {
    "ethz": Published(
        (33, 67, 116, 166, 203, 239, 274, 309, 344, 362, 382, 407, 434, 448, 470, 514, 550, 586,
         622, 657, 665),
        "7.750 / 7.576", "7.033 / 6.967", "7.052 / 6.946",
    ),
    "ethzmobil": Published(
        (7, 21, 37, 52, 66, 81, 97, 111, 136, 160, 175, 191, 205, 220, 236, 250, 275, 299, 337,
         376),
        "5.744 / 5.582", "5.014 / 4.910", "4.871 / 4.668",
    ),
}  # fmt: skip


def path_time(points: Floats) -> float:
    """Least time from standstill along the natural cubic spline through ``points`` (n, 2)."""
    car = get_car("orca")
    drive = GRAVITY_MPS2 * car.lf_m / car.wheelbase_m
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(knots, points, bc_type="natural")
    at = np.linspace(0.0, knots[-1], int(knots[-1] / _STEP_M))
    first, second = spline(at, 1), spline(at, 2)
    kappa = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.linalg.norm(
        first, axis=1
    ) ** 3
    step = np.linalg.norm(np.diff(spline(at), axis=0), axis=1)
    v = speed_profile(
        kappa,
        np.append(step, 0.0),
        GRAVITY_MPS2,
        lambda v: np.full_like(v, drive),
        lambda v: np.full_like(v, -GRAVITY_MPS2),
        1e-3,
        20.0,
        start_mps=0.0,
    )
    return float(np.sum(2 * step / (v[1:] + v[:-1])))


def objective(folder: Path, name: str) -> Callable[[Floats], float]:
    """Time by the places of the nodes, from 0 on the right to 1 on the left."""
    track = load_track(str(folder / f"{name}.csv"))
    nodes = list(PUBLISHED[name].nodes)
    width = float(track.width_left_m[0] + track.width_right_m[0])
    s = track.s_m[nodes]
    reach = track.length_m / (5 * len(nodes))
    along = track.position(s + reach) - track.position(s - reach)
    along /= np.linalg.norm(along, axis=1)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    middle, ends = track.position(s), track.position(np.array([0.0, s[0]]))

    def of(shares: Floats) -> float:
        offset = (shares - 0.5) * _SHARE * width
        return path_time(np.vstack([ends[:1], middle + offset[:, None] * left, ends[1:]]))

    return of


def direct(folder: Path, name: str, step_m: float = 0.03) -> float:
    """The least time of any path, found by derivatives.

    The path begins and ends where those of :func:`objective` do, and starts at rest. It keeps their
    distance from the edges at every point, not at nodes alone. The car can do what the objective
    allows, and steers as fast and as far as it has to.
    """
    track, car = load_track(str(folder / f"{name}.csv")), unlimited_car()
    width = float(track.width_left_m[0] + track.width_right_m[0])
    frame = open_frame(track, PUBLISHED[name].nodes[0], (1 - _SHARE) / 2 * width, step_m)
    settings = RaceLineSettings()
    path = optimise(name, frame, car_limits(car, settings), settings, [1.0])
    return path_time(path.xy_m)


def unlimited_car() -> CarParameters:
    """The Orca with the drive of the objective, and steering that limits nothing."""
    orca = get_car("orca")
    force = orca.mass_kg * GRAVITY_MPS2
    drive = DcMotor(model="dc_motor", cm1=force, cm2=0.0, cr0=0.0, cr2=0.0)
    return orca.model_copy(
        update={
            "drive": drive, "d_min": -1.0, "d_max": orca.lf_m / orca.wheelbase_m,
            "delta_rate_max_radps": 50.0, "delta_max_rad": 0.7, "friction": 1.0,
        }
    )  # fmt: skip


def open_frame(track: Track, last: int, margin_m: float, step_m: float) -> Frame:
    """A lap from the start point, at rest, and on to the track's point ``last``, both fixed."""
    tuning = get_car("orca").tuning.raceline
    curve = smooth_centreline(track, tuning)
    beyond = float(track.s_m[last]) / track.length_m
    length = curve.period * (1 + beyond)
    stations = np.linspace(0.0, length, round(length / step_m) + 1)
    frame = frame_at(stations, curve, track, tuning, margin_m)
    ends = track.position(np.array([0.0, track.s_m[last]]))
    low, high = frame.n_min_m.copy(), frame.n_max_m.copy()
    low[[0, -1]] = high[[0, -1]] = np.sum(
        (ends - frame.xy_m[[0, -1]]) * frame.normal[[0, -1]], axis=1
    )
    return replace(frame, n_min_m=low, n_max_m=high, length_m=length, start_mps=_REST_MPS)
