"""The parts that cross-validation leaves out together: spans of time, or stretches of the track.

Neighbouring samples of a drive are 20 ms apart and nearly alike, so folds of single samples would
ask for interpolation only.

*Spans* are consecutive in time. They rank kernels well, but a log holds several laps, and the laps
before and after a span pass the same corner: errors held out by time are about those of the next
lap, far below those on another track.

*Stretches* are all passages of a place. Errors held out by stretch estimate those on a track that
was not driven (docs/decisions/2026-11-23-held-out-metrics.md has how well, and why kernels are not
chosen by it). No track is
needed: in driving order, the first sample of new ground becomes a *leader*, and all samples near
it, driven in the same direction, are at its place (the leader algorithm: Hartigan, "Clustering
algorithms", 1975, chapter 3). Leaders follow one another along the path.
"""

from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from bayesrace.arrays import Rows
from learning.dataset import Dataset

__all__ = ["spans", "stretches"]

_NEAR: Final = 5.0
"""Wheelbases within which two samples are at the same place; the lanes of 1:43 tracks are six
wide."""


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
