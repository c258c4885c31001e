"""Choice of samples where there are more than the controller, or the next training, has room for.

A job that learns lap by lap keeps a bounded number, whatever is driven: those without which the
GPs would know least, and what has been driven last, for the car may have changed.
"""

from typing import Final

import numpy as np
from scipy.spatial.distance import cdist

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel
from bayesrace.gp.weights import OUTPUTS, GpWeights
from learning.dataset import Dataset

__all__ = ["MOST_NEW", "bounded", "evenly", "most_informative"]

MOST_NEW: Final = 20_000
"""Samples that may come at once; of more, evenly spread ones are looked at."""

_MAX_BYTES: Final = 1 << 32
"""Upper limit of the memory for a choice."""

_NEWEST: Final = 0.25
"""Share of the kept samples that are the last ones driven."""


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
    InputError if that memory would be more than 4 GB.
    """
    count = len(z)
    if count <= wanted:
        return np.arange(count)
    if 8 * count * wanted > _MAX_BYTES:
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


def bounded(dataset: Dataset, wanted: int, weights: GpWeights | None = None) -> Dataset:
    """At most ``wanted`` of the samples, in their order: the newest, and the most informative.

    A quarter are the last ones; an equal part of the others is chosen for each output by its
    kernel in ``weights``, evenly without them. Memory: 8 bytes times the samples (at most
    :data:`MOST_NEW` and ``wanted`` are looked at) times a quarter of ``wanted``.
    """
    if len(dataset) <= wanted:
        return dataset
    looked_at = dataset.select(evenly(len(dataset), max(MOST_NEW, wanted)))
    chosen = np.arange(len(looked_at)) >= len(looked_at) - max(1, int(_NEWEST * wanted))
    share = (wanted - int(chosen.sum())) // len(OUTPUTS)
    if weights is not None and all(weights.counts) and share:
        for output in weights.outputs:
            noise = output.noise_variance / output.signal_variance
            rest = np.flatnonzero(~chosen)
            z = looked_at.features[rest]
            rows = most_informative(output.kernel, z, output.length_scales, noise, share)
            chosen[rest[rows]] = True
    rest = np.flatnonzero(~chosen)
    chosen[rest[evenly(len(rest), wanted - int(chosen.sum()))]] = True
    return looked_at.select(chosen)
