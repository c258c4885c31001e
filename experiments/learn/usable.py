"""Why nothing could be learned from a drive, in words: the cause, and what to do about it."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from bayesrace.messages import State
from bayesrace.vehicles.parameters import CarParameters
from learning.dataset import Dataset

__all__ = ["why_unusable"]

_LOST: Final = (
    "no two states arrived one after the other: the network or this machine loses messages; give "
    "them less to do"
)

_FILTERED: Final[Mapping[str, str]] = {
    "standstill": "the car stood still, or nearly; see 'bayesrace status' for why",
    "gap": _LOST,
    "fallback": "the fallback drove, as the controller had no solution in time; give it a core of "
    "its own, a slower racing line, or weights to begin with",
    "outside limits": "inputs or steering angles are beyond the limits of car '{car}'; name the "
    "car that drives: --car",
    "steering does not match its rate": "the steering angle does not follow the rate that the "
    "plant says acted; correct the FMU's map, or the plant",
}
"""By the reasons of :func:`learning.dataset.filter_dataset` and of :mod:`learning.logs`."""


def why_unusable(
    states: Sequence[State], samples: Dataset | None, car: CarParameters, step_s: float
) -> str:
    """Empty if there are samples. The same cause gives the same words.

    ``samples``: what remained of the states; None if no two of them were ``step_s`` apart.
    """
    if samples is not None:
        reason = max(samples.dropped, key=lambda one: samples.dropped[one], default="")
        known = _FILTERED.get(reason, f"the samples are left out: {reason}")
        return "" if len(samples) else known.format(car=car.name)
    steps = [b.time_s - a.time_s for a, b in itertools.pairwise(states) if b.seq == a.seq + 1]
    if not steps:
        return _LOST
    return (
        f"states are {float(np.median(steps)):.3g} s apart, the model's step is {step_s:g} s; "
        f"start the plant with --rate {1 / step_s:g}, or name the controller that drives with "
        "--artefact"
    )
