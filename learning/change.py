"""A car that has changed: samples from before it did, moved to what they would be now.

Weights that were right predict what the newest drive did worse than they claim, from some moment
on. A sample from before then is wrong by as much as the car has changed, in every place that has
not been driven since, and mixed with new ones it makes the weights wrong where these are right, and
noisy everywhere. Left out, it takes with it all that is known of other speeds and bends.

So what the weights miss of the new samples is learned by a GP of its own, and added to the old
ones, whose standard deviations become those of what was added: far from all new samples an old one
says little (Kennedy and O'Hagan, "Predicting the output from a complex computer code when fast
approximations are available", Biometrika 2000, with the car before as the approximation of the car
now).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.gp.weights import Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.drives import Estimates
from bayesrace.learning.subset import evenly
from bayesrace.learning.symmetry import symmetric
from bayesrace.learning.target import interpolated
from bayesrace.learning.validation import validate

__all__ = ["brought_up_to_date", "said"]

_USUAL: Final = 4.0
"""Square of an error over the variance that the weights claim, up to which it says nothing; the
mean over first laps of unchanged cars on other tracks is 2.1 at most."""
_MOST: Final = 100.0
"""No single error counts for more. Less grip shows in bends alone, and there by much."""
_LEAST: Final = 200.0
"""Excess, added up over the samples from the change on, by which it has to show; never above 0 for
the first laps of 15 unchanged cars, at least 490 for as many with nine tenths of their grip."""
_FEWEST: Final = 100
"""Samples that a change is learned from at least; a shorter one waits for the next update."""
_LEARNED: Final = 400
"""New samples that the difference is learned from at most."""


def _changed_at(dataset: Dataset, weights: Weights, discretisation: Discretisation) -> int | None:
    """Number of the first sample of the car as it is now; None: it is the car of the weights.

    ``dataset``: in the order in which it was driven. What errors exceed the usual by is added up
    from the end; the car changed where the sum of an output is largest (Page's CUSUM, from the
    newest sample backwards).
    """
    seen = validate(weights, dataset, discretisation)
    excess = np.minimum((seen.error / seen.sigma) ** 2, _MOST) / _USUAL - 1
    sums = np.cumsum(excess[::-1], axis=0)
    back, output = np.unravel_index(int(np.argmax(sums)), sums.shape)
    if back + 1 < _FEWEST or sums[back, output] < _LEAST:
        return None
    return len(dataset) - 1 - int(back)


def brought_up_to_date(
    dataset: Dataset, weights: Weights, discretisation: Discretisation
) -> tuple[Dataset, int]:
    """The samples, in the order in which they were driven, as the car would do them now; and how
    many of them have been moved, from the first one on.

    ``weights``: learned before the newest ones. No sample is moved if the car has not changed, or
    if all are of the car as it is now.
    """
    first = _changed_at(dataset, weights, discretisation) if all(weights.counts) else None
    if not first:
        return dataset, 0
    before, after = dataset.select(slice(first)), dataset.select(slice(first, None))
    change, deviation = _change(before, after, weights, discretisation)
    x_next, known = before.x_next.copy(), before.deviation.copy()
    x_next[:, 3:6] += change
    known[:, :3] = np.hypot(known[:, :3], deviation)
    moved = replace(before, x_next=x_next, estimates=Estimates.settled(known))
    return concatenate([moved, after]), first


def said(moved: int, count: int) -> str:
    """That ``moved`` of ``count`` samples have been brought up to date, in words."""
    return (
        f"the car is another one since sample {moved + 1} of {count}: the samples before were "
        "moved by what is new, and count for less"
    )


def _change(
    before: Dataset, after: Dataset, weights: Weights, discretisation: Discretisation
) -> tuple[Floats, Floats]:
    """What is to be added to the residuals of samples from before, and its standard deviations,
    both (n, 3)."""
    mirrored = symmetric(after, discretisation)
    after = after.select(evenly(len(after), _LEARNED))
    if mirrored:
        after = after.with_mirror_images()
    seen = validate(weights, after, discretisation)
    columns = zip(seen.error.T, seen.sigma.T, strict=True)
    found = [interpolated(after.features, *one, before.features) for one in columns]
    means, deviations = zip(*found, strict=True)
    return np.column_stack(means), np.column_stack(deviations)
