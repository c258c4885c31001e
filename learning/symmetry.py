"""Whether a car turns left as it turns right, by what it did.

Its file may say so (``mirrored_samples``), and its training then learns from the mirror image of
each sample, too. A steering that is a degree off makes all images wrong, and with them the weights.
So a GP of the newest samples predicts their images: errors that are far beyond what it claims are
of a car with a side.
"""

from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.gaussian_process import PairDistances, maximise, starts
from bayesrace.learning.subset import evenly
from bayesrace.learning.target import Target
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
_ITERATIONS: Final = 50


def symmetric(dataset: Dataset, discretisation: Discretisation) -> bool:
    """False for a car whose file says that it is not, or whose newest samples contradict it."""
    if not dataset.car.mirrored_samples:
        return False
    newest = dataset.select(slice(-_NEWEST, None))
    newest = newest.select(evenly(len(newest), _LOOKED_AT))
    both = newest.with_mirror_images()
    z, y = both.features, residual(both, discretisation)
    own = np.zeros(len(newest), dtype=np.int64)
    with threadpool_limits(1, "blas"):
        for errors, spread in zip(y.T, both.deviation.T[:3], strict=True):
            target = Target.of("", z[::2], errors[::2], own, spread[::2])
            pairs, first = PairDistances(target.z), starts(0, 0)[0]
            fit = maximise("rbf", pairs, target.y, first, _ITERATIONS, known=target.known)
            found = target.posterior(np.arange(len(newest)), fit.covariance)
            images = (z[1::2] - z[::2].mean(axis=0)) / target.z_scale
            mean, sigma = found.predict(images)
            missed = (errors[1::2] - target.y_mean) / target.y_scale - mean
            square = missed**2 / (sigma**2 + target.known)
            if np.minimum(square, _MOST).mean() > _USUAL:
                return False
    return True
