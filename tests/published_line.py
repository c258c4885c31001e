"""The published objective of the racing line by Bayesian optimisation.

The objective is that of Jain and Morari (2020) as their program has it: nodes at their points of
the centreline, offsets over 95 % of the width, the path from the start point, at rest and on the
centreline, past the end of the lap to the first node, on the centreline; friction 1, drive force
mu m g lf / (lf + lr). Speeds are computed every centimetre, where theirs have 100 points in all:
the published line of ETHZ takes 7.046 s with theirs, 7.08 s here.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from bayesrace.arrays import Floats
from bayesrace.raceline.friction import speed_profile
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["NODES", "objective"]

_STEP_M: Final = 0.01
_SHARE: Final = 0.95


NODES: Final = {
    "ethz": (
        33, 67, 116, 166, 203, 239, 274, 309, 344, 362, 382, 407, 434, 448, 470, 514, 550, 586, 622,
        657, 665,
    ),
    "ethzmobil": (
        7, 21, 37, 52, 66, 81, 97, 111, 136, 160, 175, 191, 205, 220, 236, 250, 275, 299, 337, 376,
    ),
}  # fmt: skip
"""As points of the track's file."""


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
    nodes = list(NODES[name])
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
