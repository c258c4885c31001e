"""Whether a car turns left as it turns right, by what it did.

Its file may say so (``mirrored_samples``), and its training then learns from the mirror image of
each sample, too. A steering that is a degree off makes all images wrong, and with them the weights.
So a GP predicts every second one of the newest samples from the others: with the images of those it
must not do so worse than without. Of estimated states the file decides: smoothed ones err alike
from one to the next, by more than a GP of some of them claims.
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Flags, Floats
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.subset import evenly
from bayesrace.learning.target import interpolated
from bayesrace.learning.validation import residual

__all__ = ["symmetric"]

_NEWEST: Final = 600
"""Samples that are asked, the newest ones."""
_LOOKED_AT: Final = 200
"""Of these, evenly spread, one half to predict the other from."""
_WORSE: Final = 0.25
"""Log density that a prediction may lose by images; 0.04 at most for symmetric cars, 2.7 at least
where the steering is 1 degree off (79 and 18 drives on three tracks, ``orca``)."""
_MOST: Final = 16.0
"""Square of an error over its variance: no single one counts for more."""


def symmetric(dataset: Dataset, discretisation: Discretisation) -> bool:
    """False for a car whose file says that it is not, or whose newest samples contradict it, if
    their states were measured."""
    if not dataset.car.mirrored_samples:
        return False
    if dataset.estimates is not None and dataset.estimates.drives:
        return True
    newest = dataset.select(slice(-_NEWEST, None))
    both = newest.select(evenly(len(newest), _LOOKED_AT)).with_mirror_images()
    z, y, deviation = both.features, residual(both, discretisation), both.deviation
    sample, image = np.divmod(np.arange(len(z)), 2)
    asked, itself = sample % 2 == 1, image == 0
    for output in zip(y.T, deviation.T[:3], strict=True):
        with_images, without = (
            _density(z, *output, known, asked & itself) for known in (~asked, ~asked & itself)
        )
        if with_images < without - _WORSE:
            return False
    return True


def _density(z: Floats, errors: Floats, deviation: Floats, known: Flags, asked: Flags) -> float:
    """Mean log density (less a constant) of one output of the rows that are asked, by a GP of those
    that are known."""
    mean, sigma = interpolated(z[known], errors[known], deviation[known], z[asked])
    variance = sigma**2 + deviation[asked] ** 2
    squares = np.minimum((errors[asked] - mean) ** 2 / variance, _MOST)
    return float(-0.5 * np.mean(np.log(variance) + squares))
