"""What is measured and what is estimated, between Python and C (bayesrace_estimator.h)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import Artefact

__all__ = ["Belief", "Measurement", "fill", "read"]


class Measurement(NamedTuple):
    """What one instrument has measured at one moment of plant time."""

    time_s: float
    instrument: int
    """Its number, from 0 on."""
    of: Sequence[int]
    """Indices of the states that are measured, each once."""
    value: Sequence[float]
    deviation: Sequence[float]
    """Standard deviations, in the unit of each value."""


def fill(rows: Any, measured: Sequence[Measurement]) -> int:
    """Writes measurements into rows of C, of which there are as many; their number."""
    for row, one in zip(rows, measured, strict=False):
        row.time_s, row.instrument, row.count = one.time_s, one.instrument, len(one.of)
        for i, values in enumerate(zip(one.of, one.value, one.deviation, strict=True)):
            row.of[i], row.value[i], row.deviation[i] = values
    return len(measured)


class Belief(NamedTuple):
    """State and offsets of sensors, with their covariance."""

    time_s: float
    x: Floats
    """(nx + 2,): the states, then the offsets of the measured yaw rate and steering angle."""
    covariance: Floats
    """(nx + 2, nx + 2)"""


def read(artefact: Artefact, estimator: Any, found: Any) -> Belief | None:
    """What a br_estimator knows at the end of the last period, by way of a br_belief; None:
    nothing yet."""
    if artefact.library.br_estimator_read(estimator, found):
        return None
    x = np.frombuffer(artefact.ffi.buffer(found.x), np.float64).copy()
    covariance = np.frombuffer(artefact.ffi.buffer(found.covariance), np.float64).copy()
    return Belief(found.time_s, x, covariance.reshape(len(x), len(x)))
