"""What is learned from: runs, recordings, or arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.api.logs import Log
from bayesrace.api.runs import Run
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.dataset import Dataset, concatenate, dataset_from_arrays, filter_dataset
from bayesrace.learning.settings import Progress, TrainingSettings
from bayesrace.vehicles import Car

__all__ = ["Drive", "residuals", "train"]

Method = Literal["bayesrace", "scikit-learn"]
_METHODS: Final = ("bayesrace", "scikit-learn")


@dataclass(frozen=True, eq=False)
class Drive:
    """One unbroken drive as arrays."""

    x: ArrayLike
    """Measured states in the order of :class:`.State`, one a period, shape (n + 1, 7)."""
    u: ArrayLike
    """Inputs that acted from each state to the next, shape (n, 2): drive command, steering rate
    [rad/s]."""
    dt: float
    """Period [s]: that of the controller's stages, 0.02."""


Drives = Run | Drive | Log | Sequence[Run | Drive | Log]
"""Of one car."""


def train(
    drives: Drives,
    car: Car | None = None,
    *,
    points: int = 400,
    initial: Weights | None = None,
    method: Method = "bayesrace",
    seed: int = 0,
    progress: Progress | None = None,
) -> Weights:
    """Gaussian processes of what the e-kinematic model errs by, one each for vx, vy and omega.

    ``car``: needed for arrays; runs and recordings know theirs. ``points``: training points of each
    output at most; the most informative ones are kept. ``initial``: earlier weights to go on from,
    for an update; where the car has changed since, old samples are brought up to date. ``method``:
    ``"bayesrace"`` (kernels chosen by held-out log density, calibrated variances), or
    ``"scikit-learn"``: ``GaussianProcessRegressor`` with an RBF kernel for each output on evenly
    chosen samples, for comparison. ``progress`` is called with the share done and a text.

    InputError for drives of different cars, too few samples, or a period that no controller has.
    """
    if method not in _METHODS:
        raise InputError(f"method = {method!r}: give one of {', '.join(_METHODS)}")
    samples = _samples(drives, car)
    if method == "scikit-learn":
        from bayesrace.learning.scikit import train as train_by_scikit

        return train_by_scikit(samples, PREDICTION, points, seed)
    from bayesrace.learning.change import brought_up_to_date
    from bayesrace.learning.training import train as train_bayesrace

    if initial is not None:
        samples, _ = brought_up_to_date(samples, initial, PREDICTION)
    settings = TrainingSettings(capacity=points, seed=seed)
    return train_bayesrace(samples, PREDICTION, settings, initial, progress)


def residuals(drives: Drives, car: Car | None = None) -> tuple[Floats, Floats]:
    """What :func:`train` learns from, for regressors of one's own: features (n, 6), in the order
    vx, vy, omega, delta, d, delta_rate, and what the e-kinematic model errs by in a step (n, 3) of
    vx, vy [m/s] and omega [rad/s]. Arguments and errors as of :func:`train`."""
    from bayesrace.learning.validation import residual

    samples = _samples(drives, car)
    return samples.features, residual(samples, PREDICTION)


def _samples(drives: Drives, car: Car | None) -> Dataset:
    """What can be learned from them, all of one car."""
    if isinstance(drives, Run | Drive | Log):
        drives = [drives]
    if not drives:
        raise InputError("drives = []: give at least one run, recording or drive")
    known = [one.driven.car for one in drives if isinstance(one, Run)]
    known += [one.car for one in drives if isinstance(one, Log)]
    if car is None and not known:
        raise InputError("car = None: arrays do not say whose they are; name the car")
    return concatenate([_samples_of(one, car or known[0]) for one in drives])


def _samples_of(one: "Run | Drive | Log", car: Car) -> Dataset:
    """What can be learned from it."""
    if isinstance(one, Run):
        return one.driven.samples()
    if isinstance(one, Log):
        return one.samples(car)
    if not isinstance(one, Drive):
        raise InputError(
            f"drives: {type(one).__name__} is none; give bayesrace.Run, Drive(x, u, dt) or Log"
        )
    x, u = np.asarray(one.x, dtype=np.float64), np.asarray(one.u, dtype=np.float64)
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise InputError("drive: x or u has a number that is not finite; cut the drive there")
    return filter_dataset(dataset_from_arrays(car, one.dt, x, u))
