"""Whether a car turns left as it turns right, by what it did.

Its file may say so (``mirrored_samples``), and its training then learns from the mirror image of
each sample, too. A steering that is a degree off makes all images wrong, and with them the weights.
So a GP of the newest samples predicts their images: errors that are far beyond what it claims are
of a car with a side. Of estimated states the file decides: smoothed ones err alike from one to the
next, by more than a GP of some of them claims.
"""

from typing import Final

import numpy as np

from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.subset import evenly
from bayesrace.learning.target import interpolated
from bayesrace.learning.validation import residual

__all__ = ["symmetric"]

_NEWEST: Final = 600
"""Samples that are asked, the newest ones."""
_LOOKED_AT: Final = 200
"""Of these, evenly spread, that a GP is made of at most."""
_USUAL: Final = 6.0
"""Mean square of errors over what is claimed; 3.1 at most for symmetric cars, 13 at least where the
steering is 1 degree off (18 drives each, ``orca``)."""
_MOST: Final = 16.0
"""No single error counts for more."""


def symmetric(dataset: Dataset, discretisation: Discretisation) -> bool:
    """False for a car whose file says that it is not, or whose newest samples contradict it, if
    their states were measured."""
    if not dataset.car.mirrored_samples:
        return False
    if dataset.estimates is not None and dataset.estimates.drives:
        return True
    newest = dataset.select(slice(-_NEWEST, None))
    newest = newest.select(evenly(len(newest), _LOOKED_AT))
    both = newest.with_mirror_images()
    z, y, deviation = both.features, residual(both, discretisation), newest.deviation
    for errors, spread in zip(y.T, deviation.T[:3], strict=True):
        mean, sigma = interpolated(z[::2], errors[::2], spread, z[1::2])
        square = (errors[1::2] - mean) ** 2 / (sigma**2 + spread**2)
        if np.minimum(square, _MOST).mean() > _USUAL:
            return False
    return True
