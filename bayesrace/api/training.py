"""What is learned from: runs, recordings, or arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.api.logs import Log
from bayesrace.api.runs import Run
from bayesrace.api.values import car_of, number, numbers, validated
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.dataset import (
    Dataset,
    concatenate,
    dataset_from_arrays,
    filter_dataset,
    left_out,
)
from bayesrace.learning.settings import Progress, TrainingSettings
from bayesrace.vehicles import Car

__all__ = ["Drive", "residuals", "train"]

Method = Literal["bayesrace", "scikit-learn"]
_SAME_S: Final = 1e-9
_ALIKE: Final = 0.7
"""Of two lengths of one way, by places and by speeds: noise and sampling explain no more."""
_NAMES: Final = {"capacity": "points"}
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
    car: "Car | Path | str | None" = None,
    *,
    points: int = 400,
    initial: Weights | None = None,
    method: Method = "bayesrace",
    seed: int = 0,
    progress: Progress | None = None,
) -> Weights:
    """Gaussian processes of what the e-kinematic model errs by, one each for vx, vy and omega.

    - ``drives``: runs, recordings and arrays of one car, in the order in which they were driven.
    - ``car``: needed for arrays; runs and recordings know theirs.
    - ``points``: training points of each output at most; the most informative ones are kept.
    - ``initial``: earlier weights to go on from, for an update; where the car has changed since,
      old samples are brought up to date.
    - ``method``: ``"bayesrace"`` (kernels chosen by held-out log density, calibrated variances), or
      ``"scikit-learn"``, for comparison: ``GaussianProcessRegressor`` with an RBF kernel for each
      output, on evenly chosen samples.
    - ``seed``: of the optimiser's starts; scikit-learn has one start.
    - ``progress``: is called with the share done and a text.

    InputError for drives of different cars, too few samples, or a period that no controller has.
    """
    if method not in _METHODS:
        raise InputError(f"method = {method!r}: give one of {', '.join(_METHODS)}")
    settings = validated(TrainingSettings, {"capacity": points, "seed": seed}, _NAMES)
    if initial is not None and not isinstance(initial, Weights):
        raise InputError(f"initial = {type(initial).__name__}: give bayesrace.Weights")
    samples = _samples(drives, car)
    if method == "scikit-learn":
        if initial is not None:
            raise InputError("initial: scikit-learn begins anew; leave it, or the method")
        from bayesrace.learning.scikit import train as train_by_scikit

        report = progress or (lambda share, text: None)
        return train_by_scikit(samples, PREDICTION, points, report)
    from bayesrace.learning.change import brought_up_to_date
    from bayesrace.learning.training import train as train_bayesrace

    if initial is not None:
        samples, _ = brought_up_to_date(samples, initial, PREDICTION)
    return train_bayesrace(samples, PREDICTION, settings, initial, progress)


def residuals(drives: Drives, car: "Car | Path | str | None" = None) -> tuple[Floats, Floats]:
    """What :func:`train` learns from, for regressors of one's own: features (n, 6), in the order
    vx, vy, omega, delta, d, delta_rate, and what the e-kinematic model errs by in a step (n, 3) of
    vx, vy [m/s] and omega [rad/s]. Arguments and errors as of :func:`train`."""
    from bayesrace.learning.validation import residual

    samples = _samples(drives, car)
    if not len(samples):
        raise InputError(f"drives: no sample can be used (left out: {left_out(samples.dropped)})")
    return samples.features, residual(samples, PREDICTION)


def _samples(drives: Drives, car: "Car | Path | str | None") -> Dataset:
    """What can be learned from them, all of one car."""
    try:
        drives = [drives] if isinstance(drives, Run | Drive | Log) else list(drives)
    except TypeError:
        drives = [drives]  # type: ignore[list-item]
    if not drives:
        raise InputError("drives = []: give at least one run, recording or drive")
    known = [one.car for one in drives if isinstance(one, Run)]
    known += [one.car for one in drives if isinstance(one, Log)]
    if car is not None:
        known.append(car_of(car))
    if not known:
        raise InputError("car = None: arrays do not say whose they are; name the car")
    if any(one != known[0] for one in known):
        names = ", ".join(one.identity for one in known)
        raise InputError(f"drives of several cars ({names}): train on those of one")
    return concatenate([_samples_of(one, known[0]) for one in drives])


def _samples_of(one: "Run | Drive | Log", car: Car) -> Dataset:
    """What can be learned from it."""
    if isinstance(one, Run):
        if abs(one.driven.step_s - PREDICTION.step_s) > _SAME_S:
            raise InputError(
                f"the run's states are {one.driven.step_s:g} s apart, the controller's stages "
                f"{PREDICTION.step_s:g} s: give a Drive of states that are as far apart, and of "
                "the means of the inputs between them"
            )
        return one.driven.samples()
    if isinstance(one, Log):
        return one.samples(car)
    if not isinstance(one, Drive):
        raise InputError(
            f"drives: {type(one).__name__} is none; give bayesrace.Run, Drive(x, u, dt) or Log"
        )
    x, u = numbers(one.x, "drive.x"), numbers(one.u, "drive.u")
    number(one.dt, "drive.dt", 1e-3, 1.0, "the period in seconds, one number")
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise InputError("drive: x or u has a number that is not finite; cut the drive there")
    samples = dataset_from_arrays(car, float(one.dt), x, u)
    _check_units(car, x, u, float(one.dt))
    return filter_dataset(samples)


def _check_units(car: Car, x: Floats, u: Floats, dt: float) -> None:
    """InputError for arrays that are in other units, or whose columns are exchanged."""
    drive_most = 2 * max(-car.d_min, car.d_max)
    sizes = (
        ("x[:, 3:5]", x[:, 3:5], 2 * car.drive.top_speed_mps(car.d_max), "metres per second"),
        ("x[:, 5]", x[:, 5], car.tuning.plausible.yaw_rate_radps, "radians per second"),
        ("x[:, 6]", x[:, 6], 2 * car.delta_max_rad, "radians"),
        ("u[:, 0]", u[:, 0], drive_most, f"the drive command in its unit, {car.drive.unit}"),
        ("u[:, 1]", u[:, 1], 2 * car.delta_rate_max_radps, "radians per second"),
    )
    for name, column, most, unit in sizes:
        if np.abs(column).max(initial=0.0) > most:
            raise InputError(
                f"drive.{name} is up to {np.abs(column).max():.4g}, more than '{car.name}' can "
                f"({most:.4g}): give {unit}"
            )
    moved_m = float(np.hypot(*np.diff(x[:, :2], axis=0).T).sum())
    way_m = dt * float(np.hypot(x[:-1, 3], x[:-1, 4]).sum())
    if not _ALIKE * way_m <= moved_m <= way_m / _ALIKE:
        raise InputError(
            f"drive: by x[:, :2] the car moves {moved_m:.4g} m, by x[:, 3:5] and dt {way_m:.4g} m: "
            "give metres, metres per second, and the period in seconds"
        )
    turned = np.remainder(np.diff(x[:, 2]) + np.pi, 2 * np.pi) - np.pi
    if np.abs(turned).sum() > 5 * np.abs(dt * x[:, 5]).sum() + 2 * np.pi:
        raise InputError("drive.x[:, 2] turns faster than x[:, 5] says: give both in radians")
