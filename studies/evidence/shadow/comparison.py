"""Where a shadow would have done otherwise, what the plans of both promised and what came, and how
long both took."""

from typing import Final

import numpy as np
from pydantic import Field
from scipy.interpolate import CubicHermiteSpline

from bayesrace.arrays import Flags, Floats
from bayesrace.operation.analysis.results import Percentiles, ResultModel
from bayesrace.studies.evidence.inputs import INPUTS
from bayesrace.studies.evidence.shadow.cycles import Beside, Side
from bayesrace.tracks import Track

__all__ = ["Compared", "Place", "Promise", "apart", "compare", "plan_errors"]

_ALIKE: Final = 0.02, 0.2
"""Inputs that differ by no more (d, delta_rate [rad/s]) bring about nearly the same."""
_HORIZONS_S: Final = 0.1, 0.2, 0.4
_PLACES: Final = 5
_NEAR_S: Final = 0.5
"""Between two of the largest differences."""


class Place(ResultModel):
    """One of the largest differences."""

    time_s: float
    x_m: float
    y_m: float
    s_m: float | None = Field(description="along the centreline, where the track is known")
    driving: tuple[float, ...] = Field(description="the input that acted")
    shadow: tuple[float, ...]
    level: int = Field(description="of the shadow's fallback; 0: a solution")


class Promised(ResultModel):
    """By the plans of one of the two."""

    off_m: Percentiles = Field(description="distance of planned and actual position")
    alike_m: Percentiles | None = Field(description="of these: where both decided nearly the same")
    way_m: float = Field(description="mean length of the way as planned")


class Promise(ResultModel):
    """Plans against what came, after a time."""

    after_s: float
    plans: int
    alike: int = Field(description="of these: where both decided nearly the same")
    controller: Promised
    shadow: Promised
    came_m: float = Field(description="mean length of the way")


class Compared(ResultModel):
    """One shadow in one run."""

    run: int
    shadow: str
    lockstep: bool
    driving_weights: tuple[str, ...]
    shadow_weights: tuple[str, ...]
    inputs: int = Field(description="of the controller while it drove")
    answered: int
    apart: dict[str, Percentiles] = Field(description="inputs: d [command], delta_rate [rad/s]")
    places: tuple[Place, ...]
    driving_solutions: float = Field(description="share of the cycles")
    shadow_solutions: float
    driving_step_us: Percentiles
    shadow_step_us: Percentiles
    shadow_missed: int = Field(description="cycles that took longer than their period")
    promises: tuple[Promise, ...]


def apart(one: Beside) -> Floats:
    """By how much the inputs differ, shape (n, 2)."""
    return np.abs(one.shadow.u - one.driving.u)


def compare(one: Beside, track: Track | None = None) -> Compared:
    """The numbers."""
    differences = apart(one)
    alike = np.asarray((differences <= _ALIKE).all(axis=1))
    promises = (_promise(one, after_s, alike) for after_s in _HORIZONS_S)
    return Compared(
        run=one.run, shadow=one.name, lockstep=one.lockstep, inputs=one.inputs,
        driving_weights=one.driving.versions, shadow_weights=one.shadow.versions,
        answered=len(one.time_s),
        apart=dict(zip(INPUTS, map(Percentiles.of, differences.T), strict=True)),
        places=tuple(_places(one, differences, track)),
        driving_solutions=float(np.mean(one.driving.level == 0)),
        shadow_solutions=float(np.mean(one.shadow.level == 0)),
        driving_step_us=Percentiles.of(one.driving.solve_us),
        shadow_step_us=Percentiles.of(one.shadow.solve_us),
        shadow_missed=one.shadow.missed,
        promises=tuple(found for found in promises if found is not None),
    )  # fmt: skip


def _places(one: Beside, differences: Floats, track: Track | None) -> list[Place]:
    """The largest differences, by what both inputs may differ by at most."""
    share = (differences / np.maximum(np.ptp(one.driving.u, axis=0), 1e-9)).max(axis=1)
    rows: list[int] = []
    for row in np.argsort(-share, kind="stable").tolist():
        if share[row] > 0 and all(abs(one.time_s[row] - one.time_s[at]) > _NEAR_S for at in rows):
            rows.append(row)
        if len(rows) == _PLACES:
            break
    s_m = None if track is None else track.project_path(one.x[:, :2]).s_m
    return [
        Place(
            time_s=one.time_s[row], x_m=one.x[row, 0], y_m=one.x[row, 1],
            s_m=None if s_m is None else s_m[row], driving=tuple(one.driving.u[row]),
            shadow=tuple(one.shadow.u[row]), level=one.shadow.level[row],
        )
        for row in rows
    ]  # fmt: skip


def plan_errors(one: Beside, side: Side, after_s: float) -> Floats:
    """Distance of planned and actual position that long after the plan's beginning (n,) [m], and
    the lengths of both ways; shape (n, 3). NaN where there is no plan, or nothing has come."""
    k = round(after_s / side.step_s) if side.step_s else 0
    found = np.full((len(side.plans), 3), np.nan)
    psi, vx, vy = one.came[:, 2:5].T
    velocity = np.column_stack(
        [vx * np.cos(psi) - vy * np.sin(psi), vx * np.sin(psi) + vy * np.cos(psi)]
    )
    came = CubicHermiteSpline(one.came_s, one.came[:, :2], velocity, extrapolate=False)
    for row, plan, begins_s in zip(found, side.plans, side.begins_s, strict=True):
        if 0 < k < len(plan):
            actual = came(begins_s + side.step_s * np.arange(k + 1))
            row[0] = np.hypot(*(plan[k, :2] - actual[k]))
            row[1:] = [_length(way) for way in (plan[: k + 1, :2], actual)]
    return found


def _length(way: Floats) -> float:
    return float(np.hypot(*np.diff(way, axis=0).T).sum())


def _promise(one: Beside, after_s: float, alike: Flags) -> Promise | None:
    sides = [plan_errors(one, side, after_s) for side in (one.driving, one.shadow)]
    both = np.isfinite(sides).all(axis=(0, 2))
    if not both.any():
        return None
    same = both & alike
    controller, shadow = (
        Promised(
            off_m=Percentiles.of(found[both, 0]),
            alike_m=Percentiles.of(found[same, 0]) if same.any() else None,
            way_m=float(found[both, 1].mean()),
        )
        for found in sides
    )
    return Promise(
        after_s=after_s, plans=int(both.sum()), alike=int(same.sum()), controller=controller,
        shadow=shadow, came_m=float(sides[0][both, 2].mean()),
    )  # fmt: skip
