"""Samples that a GP keeps, and those that cross-validation leaves out together.

A controller has room for some samples only. A job that learns lap by lap keeps a bounded number,
whatever is driven: those without which the GPs would know least, and what has been driven last, for
the car may have changed.

Cross-validation leaves out spans of time, or stretches of the track. Neighbouring samples of a
drive are 20 ms apart and nearly alike, so folds of single samples would ask for interpolation only.

*Spans* are consecutive in time. They rank kernels well, but a log holds several laps, and the laps
before and after a span pass the same corner: errors held out by time are about those of the next
lap, far below those on another track.

*Stretches* are all passages of a place. Errors held out by stretch estimate those on a track that
was not driven (docs/decisions/2026-11-23-held-out-metrics.md has how well, and why kernels are not
chosen by it). No track is needed: in driving order, the first sample of new ground becomes a
*leader*, and all samples near it, driven in the same direction, are at its place (the leader
algorithm: Hartigan, "Clustering algorithms", 1975, chapter 3). Leaders follow one another along the
path.
"""

from typing import Final

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel
from bayesrace.gp.weights import OUTPUTS, Weights
from bayesrace.learning.dataset import Dataset

__all__ = ["MOST_NEW", "bounded", "evenly", "most_informative", "spans", "stretches"]

MOST_NEW: Final = 20_000
"""Samples that may come at once; of more, evenly spread ones are looked at."""

_MAX_BYTES: Final = 1 << 32
"""Upper limit of the memory for a choice."""

_NEWEST: Final = 0.25
"""Share of the kept samples that are the last ones driven."""

_NEAR: Final = 5.0
"""Wheelbases within which two samples are at the same place; the lanes of 1:43 tracks are six
wide."""


def evenly(count: int, wanted: int) -> Rows:
    """``wanted`` of ``count`` indices, evenly spaced; all if there are not more."""
    if count <= wanted:
        return np.arange(count)
    return np.floor((np.arange(wanted) + 0.5) * count / wanted).astype(np.int64)


def most_informative(
    kind: str, z: Floats, length_scales: Floats, noise_ratio: Floats | float, wanted: int
) -> Rows:
    """Indices of ``wanted`` samples, each of largest posterior variance given those before it.

    A pivoted Cholesky factorisation: O(n wanted^2) time, O(n wanted) memory. ``noise_ratio``, one
    for all or (n,), is noise over signal variance. Sorted: samples stay in the order in which they
    were driven. InputError if that memory would be more than 4 GB.
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
    variance, noise = np.ones(count), np.broadcast_to(noise_ratio, count)
    columns = np.zeros((wanted, count))
    chosen = np.zeros(wanted, dtype=np.int64)
    for step in range(wanted):
        pivot = int(np.argmax(variance))
        chosen[step] = pivot
        column = kernel(kind, cdist(scaled[pivot : pivot + 1], scaled, "sqeuclidean")[0])
        column -= columns[:step, pivot] @ columns[:step]
        column /= np.sqrt(max(variance[pivot], 0.0) + noise[pivot])
        columns[step] = column
        variance -= column**2
        variance[pivot] = -np.inf
    return np.sort(chosen)


def bounded(dataset: Dataset, wanted: int, weights: Weights | None = None) -> Dataset:
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


def spans(samples: int, count: int) -> Rows:
    """Number of the span, 0 to ``count - 1``, of each of ``samples`` in driving order, (n,)."""
    parts = np.array_split(np.arange(samples), count)
    return np.repeat(np.arange(count), [len(part) for part in parts])


def stretches(dataset: Dataset, count: int) -> Rows:
    """Number of the stretch, 0 to ``count - 1``, of each sample, (n,).

    Stretches have about as many samples each, and at least two are not empty if there are two
    samples. A place that holds more than a stretch should, such as a standing start repeated or a
    small circle, is cut by time.
    """
    leader = _leaders(dataset)
    total = len(leader)
    rank = np.empty(total, dtype=np.int64)
    rank[np.argsort(leader, kind="stable")] = np.arange(total)
    size = np.bincount(leader)
    first = np.cumsum(size) - size
    whole = size[leader] * count <= total
    number: Rows = np.where(whole, first[leader], rank) * count // max(total, 1)
    return number


def _leaders(dataset: Dataset) -> Rows:
    """Number of the leader that each sample follows, in driving order."""
    xy, psi = dataset.x[:, :2], dataset.x[:, 2]
    near_m = _NEAR * dataset.car.wheelbase_m
    tree = cKDTree(xy)
    leader = np.full(len(xy), -1, dtype=np.int64)
    number = 0
    for row in range(len(xy)):
        if leader[row] < 0:
            near = np.array(tree.query_ball_point(xy[row], near_m))
            along = np.cos(psi[near] - psi[row]) > 0
            leader[near[along & (leader[near] < 0)]] = number
            number += 1
    return leader
