"""Samples of states that are estimated: smoothed by a random walk as they are read, and by the
learned model as they are learned from."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Protocol, TypeVar

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.columns import Columns
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.conditioning import conditioned
from bayesrace.learning.dataset import ROUNDING, Dataset, consecutive
from bayesrace.learning.drives import Drive, Estimates
from bayesrace.learning.kalman import Smoothed
from bayesrace.learning.smoothing import corrected_steps, smooth
from bayesrace.vehicles.parameters import Car

__all__ = ["learned_in_turns", "smoothed_again", "smoothed_states"]

_NO_POSITION: Final = "no position was read"
_NO_STEERING: Final = "no steering angle is known"
_REMEDIES: Final = {
    _NO_POSITION: "no two poses in a row agree, or too little was read; does motion capture see "
    "the car, and do its times fit?",
    _NO_STEERING: "record a run from its start, or the telemetry with it",
}
"""By the reason why a part of a drive is left out."""

_NX: Final = 7
_ROUNDS: Final = 2
_LONGEST: Final = 5_000
"""States that are smoothed at once, which takes some 20 kB for each of their events."""
_NOISE: Final = 0.65
"""Of the noise that is learned from smoothed states, what is the model's. The rest is what the
smoothing left unknown, which the next one would only confirm."""


class _Learned(Protocol):
    @property
    def weights(self) -> Weights: ...


L = TypeVar("L", bound=_Learned)


def smoothed_states(
    states: Columns, cycles: Columns, car: Car, step_s: float
) -> tuple[Columns, Estimates, Counter[str]]:
    """``states`` with ``x`` smoothed by the random walk where they are estimated; how well they are
    known, row by row; and how many are of parts that nothing can be made of, by reason.

    Columns as of :func:`bayesrace.learning.sources.dataset_from_columns`. InputError if none of the
    states is left.
    """
    lost = Counter[str]()
    discretisation = PREDICTION.model_copy(update={"step_s": step_s})
    known, filled = ~states["estimated"], states.copy()
    deviation, origin = np.zeros((len(states), 4)), np.full((len(states), 2), -1)
    drives: list[Drive] = []
    found: Smoothed | None = None
    for rows in _unbroken(states, step_s):
        before = found if known[rows[0]] else None
        drive = _drive(states[rows], cycles, step_s, before)
        found = None if drive is None else smooth(drive, car, discretisation, None)
        if drive is None or found is None:
            lost[_NO_STEERING if drive is None else _NO_POSITION] += len(rows)
            continue
        own = rows[found.rows]
        known[rows[0]] = False  # also the last one of the part before
        filled["x"][own], known[own] = found.x[:, :_NX], True
        deviation[own] = _deviation(found, drive, car, discretisation, None)
        origin[own, 0], origin[own, 1] = len(drives), found.rows
        drives.append(replace(drive, path=found.path, refused=found.refused))
    kept = np.flatnonzero(known)
    if lost and not len(kept):
        reason = max(lost, key=lambda one: lost[one])
        raise InputError(f"{reason}: {_REMEDIES[reason]}")
    return filled[kept], Estimates(deviation, origin, tuple(drives)).select(kept), lost


def smoothed_again(dataset: Dataset, discretisation: Discretisation, weights: Weights) -> Dataset:
    """The same samples, those whose drives are at hand smoothed by the corrected model. Those of a
    drive that it cannot follow stay as they are, without their drive."""
    estimates = dataset.estimates
    if estimates is None:
        return dataset
    x, x_next, deviation = dataset.x.copy(), dataset.x_next.copy(), estimates.deviation.copy()
    origin = estimates.origin.copy()
    drives: list[Drive] = []
    for number, drive in enumerate(estimates.drives):
        found = smooth(drive, dataset.car, discretisation, weights)
        own = np.flatnonzero(estimates.origin[:, 0] == number)
        if found is None:
            origin[own] = -1
            drives.append(drive)
            continue
        place = np.searchsorted(found.rows, estimates.origin[own, 1])
        x[own], x_next[own] = found.x[place, :_NX], found.x[place + 1, :_NX]
        deviation[own] = _deviation(found, drive, dataset.car, discretisation, weights)[place]
        drives.append(replace(drive, path=found.path, refused=found.refused))
    again = Estimates(deviation, origin, tuple(drives)).select(slice(None))
    return replace(dataset, x=x, x_next=x_next, estimates=again)


def learned_in_turns(
    dataset: Dataset,
    discretisation: Discretisation,
    weights: Weights | None,
    learn: Callable[[Dataset, Weights | None], L],
    capacity: int,
) -> tuple[Dataset, L, Weights]:
    """The samples smoothed, what ``learn`` has made of them, and its weights conditioned on the
    readings, each by the weights before: ``weights``, or such of the samples as they are given.

    Weights that are not conditioned where the filter fails. ``capacity``: points of an output at
    most. Variances are not to be widened by ``learn``.
    """
    before = weights or _surer(learn(dataset, None).weights)
    for _ in range(_ROUNDS):
        dataset = smoothed_again(dataset, discretisation, before)
        made = learn(dataset, before)
        try:
            before = conditioned(made.weights, dataset, discretisation, capacity, _NOISE)
        except (np.linalg.LinAlgError, InputError):
            return dataset, made, made.weights
    return dataset, made, before


def _surer(weights: Weights) -> Weights:
    a, b, c = (replace(one, noise_variance=_NOISE * one.noise_variance) for one in weights.outputs)
    return replace(weights, outputs=(a, b, c))


def _unbroken(states: Columns, step_s: float) -> list[Rows]:
    """Rows of each estimated drive in which no state is missing; a long one is in parts, which have
    the state in common at which the one ends and the next begins."""
    alike = states["estimated"][1:] == states["estimated"][:-1]
    joined = consecutive(states, step_s) & alike
    parts = np.split(np.arange(len(states)), np.flatnonzero(~joined) + 1)
    return [
        part[begin : begin + _LONGEST]
        for part in parts if states["estimated"][part[0]]
        for begin in range(0, max(len(part) - 1, 1), _LONGEST - 1)
    ]  # fmt: skip


def _drive(
    states: Columns, cycles: Columns, step_s: float, before: Smoothed | None
) -> Drive | None:
    """None where the steering angle is not known at its first state: neither is that a run's, whose
    wheels are straight, nor the last one of the part ``before``, nor has a controller estimated
    any."""
    run, seq, time_s, u = (states[name].copy() for name in ("run", "seq", "time_s", "u_applied"))
    readings = tuple(one for several in states["readings"] for one in several)
    if time_s[0] < step_s - ROUNDING:
        return Drive(time_s, u, readings)
    if before is not None:
        angle_rad, variance = before.x[-1, 6], before.covariance[-1, 6, 6]
        return Drive(time_s, u, readings, float(angle_rad), float(np.sqrt(variance)))
    own = (cycles["run"] == run[0]) & (cycles["state_seq"] >= seq[0])
    own = cycles[own & (cycles["state_seq"] <= seq[-1])]
    known = [one for one in own if one["estimate"] and one["deviation"]]
    if not known:
        return None
    first = min(known, key=lambda one: int(one["state_seq"]))
    turned_rad = step_s * u[1 : first["state_seq"] - seq[0] + 1, 1].sum()
    angle_rad = float(first["estimate"][6] - turned_rad)
    return Drive(time_s, u, readings, angle_rad, float(first["deviation"][6]))


def _deviation(
    found: Smoothed,
    drive: Drive,
    car: Car,
    discretisation: Discretisation,
    weights: Weights | None,
) -> Floats:
    """Standard deviations (m, 4) of the steps from the smoothed states on, and of the angles; of
    the last state's step there is none."""
    x, u = found.x[:-1, :_NX], drive.u[found.rows[1:]]
    h = np.full(len(x), discretisation.step_s)
    slope = corrected_steps(x, x, u, h, car, discretisation, weights).slope
    spread = np.zeros((len(found.x), 4))
    spread[:-1, :3] = np.sqrt(found.step_variance(slope))
    spread[:, 3] = np.sqrt(found.covariance[:, 6, 6])
    return spread
