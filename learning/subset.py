"""Choice of samples where there are more than the controller has room for."""

from typing import Final

import numpy as np
from scipy.spatial.distance import cdist

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel

__all__ = ["MAX_BYTES", "evenly", "most_informative"]

MAX_BYTES: Final = 1 << 32
"""Upper limit of the memory for a choice."""


def evenly(count: int, wanted: int) -> Rows:
    """``wanted`` of ``count`` indices, evenly spaced; all if there are not more."""
    if count <= wanted:
        return np.arange(count)
    return np.floor((np.arange(wanted) + 0.5) * count / wanted).astype(np.int64)


def most_informative(
    kind: str, z: Floats, length_scales: Floats, noise_ratio: float, wanted: int
) -> Rows:
    """Indices of ``wanted`` samples, each of largest posterior variance given those before it.

    A pivoted Cholesky factorisation: O(n wanted^2) time, O(n wanted) memory. ``noise_ratio`` is
    noise over signal variance. Sorted: samples stay in the order in which they were driven.
    InputError if that memory would be more than :data:`MAX_BYTES`.
    """
    count = len(z)
    if count <= wanted:
        return np.arange(count)
    if 8 * count * wanted > MAX_BYTES:
        raise InputError(
            f"choosing {wanted} of {count} samples would take {8e-9 * count * wanted:.0f} GB of "
            "memory; give fewer samples, or choose fewer"
        )
    scaled = z / length_scales
    variance = np.ones(count)
    columns = np.zeros((wanted, count))
    chosen = np.zeros(wanted, dtype=np.int64)
    for step in range(wanted):
        pivot = int(np.argmax(variance))
        chosen[step] = pivot
        column = kernel(kind, cdist(scaled[pivot : pivot + 1], scaled, "sqeuclidean")[0])
        column -= columns[:step, pivot] @ columns[:step]
        column /= np.sqrt(max(variance[pivot], 0.0) + noise_ratio)
        columns[step] = column
        variance -= column**2
        variance[pivot] = -np.inf
    return np.sort(chosen)
