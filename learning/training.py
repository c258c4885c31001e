"""From samples to mean-function weights: one GP per output of the residual.

1. Standardise features and targets, once (scikit-learn's own ``normalize_y`` stays off).
2. Per output and candidate kernel: hyperparameters by marginal likelihood from seeded starts, or
   from given weights (:mod:`learning.hyperparameters`), on at most ``hyper_points`` samples.
3. Per output: the kernel of largest held-out log density on contiguous blocks
   (:mod:`learning.crossvalidation`).
4. Factorise with scikit-learn on all samples, or on the most informative ones that fit.
5. Scale all variances so that the 95 % interval holds 95 % of the held-out errors, if it held
   less. The mean does not change. A likelihood that finds the data noise-free and smooth is
   over-confident when the model is not quite right; setting the variance by cross-validation is
   the known remedy (Bachoc, "Cross validation and maximum likelihood estimations of
   hyper-parameters of Gaussian processes with model misspecification", CSDA 2013).

Only training samples are used for any of this.
"""

import hashlib
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.linalg import cho_solve
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS, GpOutput, GpWeights, encode_weights
from bayesrace.integrators import Discretisation
from learning.crossvalidation import HeldOut, held_out
from learning.dataset import Dataset
from learning.hyperparameters import Fit, best, maximise, starts
from learning.residual import identity, residual
from learning.subset import evenly, most_informative

__all__ = ["MIN_SAMPLES", "Progress", "TrainingSettings", "regressor", "train"]

Floats = NDArray[np.float64]
Kernel = Literal["rbf", "matern05", "matern15", "matern25"]

Progress = Callable[[float, str], None]
"""Called from the training's own thread with the share done (0 to 1) and what was done."""

MIN_SAMPLES: Final = 20

_NU: Final = {"matern05": 0.5, "matern15": 1.5, "matern25": 2.5}


class TrainingSettings(BaseModel):
    """How to train; the defaults use training samples alone to decide."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kernels: tuple[Kernel, ...] = Field(
        default=("rbf", "matern25"),
        min_length=1,
        description="candidates; the best one per output by held-out log density is taken",
    )
    restarts: int = Field(default=2, ge=0, le=100, description="further seeded starts per kernel")
    seed: int = Field(default=0, ge=0)
    capacity: int = Field(default=1024, ge=1, description="training points per output at most")
    hyper_points: int = Field(
        default=400,
        ge=MIN_SAMPLES,
        description="samples that hyperparameters are found with at most",
    )
    iterations: int = Field(default=100, ge=1, description="optimiser iterations per start")
    warm_iterations: int = Field(
        default=30, ge=1, description="the same, starting from given weights"
    )
    blocks: int = Field(default=10, ge=2, description="contiguous blocks of the cross-validation")
    threads: int = Field(default=0, ge=0, description="parallel fits; 0 is one per core")


@dataclass(frozen=True)
class _Scaling:
    """Features and one output in units of their standard deviation about their mean."""

    z_mean: Floats
    z_scale: Floats
    y_mean: float
    y_scale: float

    def features(self, z: Floats) -> Floats:
        scaled: Floats = (z - self.z_mean) / self.z_scale
        return scaled

    def targets(self, y: Floats) -> Floats:
        scaled: Floats = (y - self.y_mean) / self.y_scale
        return scaled


def _scaling(z: Floats, y: Floats) -> _Scaling:
    z_scale, y_scale = z.std(axis=0), float(y.std())
    # A column that never changes carries nothing; dividing by one leaves it at zero.
    z_scale = np.where(z_scale > 1e-12, z_scale, 1.0)
    return _Scaling(z.mean(axis=0), z_scale, float(y.mean()), y_scale if y_scale > 1e-12 else 1.0)


def _sklearn_kernel(kind: str, theta: Floats) -> Any:
    signal, lengths, noise = math.exp(theta[0]), np.exp(theta[1:-1]), math.exp(theta[-1])
    base = RBF(lengths) if kind == "rbf" else Matern(lengths, nu=_NU[kind])
    return ConstantKernel(signal) * base + WhiteKernel(noise)


def regressor(kind: str, theta: Floats, z: Floats, y: Floats) -> GaussianProcessRegressor:
    """scikit-learn's GP, hyperparameters fixed, fitted to scaled ``z`` (n, 6) and ``y`` (n,)."""
    gp = GaussianProcessRegressor(_sklearn_kernel(kind, theta), alpha=0.0, optimizer=None)
    try:
        return gp.fit(z, y)
    except np.linalg.LinAlgError as error:
        raise InputError("GP training: covariance is singular; are samples repeated?") from error


def _held_out(gp: GaussianProcessRegressor, y: Floats, blocks: int) -> HeldOut:
    inverse = cho_solve((gp.L_, True), np.eye(len(y)))
    return held_out(0.5 * (inverse + inverse.T), y, blocks)


def _theta_of(output: GpOutput, scaling: _Scaling) -> Floats:
    """Hyperparameters of earlier weights in the units of new scaling."""
    ratio = (output.y_scale / scaling.y_scale) ** 2
    lengths = output.length_scales / scaling.z_scale
    noise = max(output.noise_variance, 1e-12)
    return np.log([output.signal_variance * ratio, *lengths, noise * ratio])


@dataclass(frozen=True)
class _Task:
    """One optimisation: output number, kernel, start."""

    output: int
    kind: str
    start: Floats
    iterations: int


def _tasks(
    settings: TrainingSettings, scalings: Sequence[_Scaling], initial: GpWeights | None
) -> list[_Task]:
    if initial is None or not all(initial.counts):
        guesses = starts(settings.restarts, settings.seed)
        return [
            _Task(i, kind, guess, settings.iterations)
            for guess in guesses
            for kind in settings.kernels
            for i in range(len(OUTPUTS))
        ]
    # The kernel that suits more data may be another one: those not in use start anew, once.
    tasks = []
    for i, (output, scaling) in enumerate(zip(initial.outputs, scalings, strict=True)):
        warm = _theta_of(output, scaling)
        tasks.append(_Task(i, output.kernel, warm, settings.warm_iterations))
        others = [kind for kind in settings.kernels if kind != output.kernel]
        first = starts(0, settings.seed)[0]
        tasks += [_Task(i, kind, first, settings.iterations) for kind in others]
    return tasks


def _run(
    tasks: Sequence[_Task], z: Floats, targets: Sequence[Floats], threads: int, report: Progress
) -> list[Fit]:
    """All optimisations, several at once, results in the order of the tasks."""
    with ThreadPoolExecutor(threads) as pool:
        futures = [
            pool.submit(maximise, t.kind, z, targets[t.output], t.start, t.iterations)
            for t in tasks
        ]
        for done, future in enumerate(as_completed(futures), start=1):
            task = tasks[futures.index(future)]
            report(0.9 * done / len(tasks), f"{OUTPUTS[task.output]}: {task.kind}")
            future.result()
    return [future.result() for future in futures]


def _choose(fits: Sequence[Fit], z: Floats, y: Floats, blocks: int) -> Fit:
    """Best start per kernel by likelihood, then best kernel by held-out log density."""
    kinds = list(dict.fromkeys(fit.kind for fit in fits))
    candidates = [best([fit for fit in fits if fit.kind == kind]) for kind in kinds]
    if len(candidates) == 1:
        return candidates[0]
    scores = [_held_out(regressor(c.kind, c.theta, z, y), y, blocks) for c in candidates]
    return max(zip(candidates, scores, strict=True), key=lambda pair: pair[1].log_density)[0]


def _finish(
    fit: Fit, scaling: _Scaling, z_raw: Floats, y: Floats, settings: TrainingSettings
) -> tuple[GpOutput, dict[str, float]]:
    """Factorises with the chosen hyperparameters and calibrates the variance."""
    signal, noise = math.exp(fit.theta[0]), math.exp(fit.theta[-1])
    z, lengths = scaling.features(z_raw), np.exp(fit.theta[1:-1])
    rows = most_informative(fit.kind, z, lengths, noise / signal, settings.capacity)
    gp = regressor(fit.kind, fit.theta, z[rows], y[rows])
    check = _held_out(gp, y[rows], settings.blocks)
    scale = max(1.0, check.variance_scale)
    output = GpOutput(
        kernel=fit.kind,
        length_scales=lengths * scaling.z_scale,
        signal_variance=signal * scale,
        noise_variance=noise * scale,
        inputs=z_raw[rows],
        alpha=gp.alpha_ / scale,
        y_mean=scaling.y_mean,
        y_scale=scaling.y_scale,
    )
    metrics = {
        "log_likelihood": fit.log_likelihood,
        "held_out_rmse": check.rmse * scaling.y_scale,
        "held_out_log_density": check.log_density - math.log(scaling.y_scale),
        "held_out_coverage": check.coverage,
        "variance_scale": scale,
        "points": float(len(rows)),
    }
    return output, metrics


def train(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings | None = None,
    initial: GpWeights | None = None,
    progress: Progress | None = None,
) -> GpWeights:
    """Weights that correct the discretised nominal model of the dataset's car.

    ``initial``: earlier weights of the same car and discretisation, for the model update: their
    hyperparameters are refined instead of searched anew, and other candidate kernels start once.
    InputError for too few samples or weights of another model.
    """
    settings, report = settings or TrainingSettings(), progress or (lambda share, text: None)
    name = identity(dataset, discretisation)
    if len(dataset) < MIN_SAMPLES:
        left_out = ", ".join(f"{n} {why}" for why, n in dataset.dropped.items()) or "none"
        raise InputError(
            f"GP training: {len(dataset)} samples, at least {MIN_SAMPLES} are needed "
            f"(left out: {left_out}); drive longer"
        )
    if initial is not None and initial.discretisation != name:
        raise InputError(
            f"GP training: cannot start from weights for {initial.discretisation}, this is {name}"
        )
    z, y = dataset.features, residual(dataset, discretisation)
    scalings = [_scaling(z, column) for column in y.T]
    targets = [s.targets(column) for s, column in zip(scalings, y.T, strict=True)]
    scaled = scalings[0].features(z)
    rows = evenly(len(z), settings.hyper_points)
    subset, subset_targets = scaled[rows], [column[rows] for column in targets]
    tasks = _tasks(settings, scalings, initial)
    # One BLAS thread per fit: the matrices are small, and the fits run side by side.
    with threadpool_limits(1, "blas"):
        threads = settings.threads or os.cpu_count() or 1
        fits = _run(tasks, subset, subset_targets, threads, report)
        outputs, metrics = [], {}
        for i, label in enumerate(OUTPUTS):
            own = [fit for fit, task in zip(fits, tasks, strict=True) if task.output == i]
            fit = _choose(own, subset, subset_targets[i], settings.blocks)
            output, metrics[f"training {label}"] = _finish(
                fit, scalings[i], z, targets[i], settings
            )
            outputs.append(output)
            report(0.9 + 0.1 * (i + 1) / len(OUTPUTS), f"{label}: {fit.kind} chosen")
    weights = GpWeights(
        version="unnamed",
        car=dataset.car.name,
        discretisation=name,
        outputs=(outputs[0], outputs[1], outputs[2]),
        dataset_digest=dataset.digest(),
        metrics=metrics,
    )
    # Named by content: the same samples and settings give the same version.
    digest = hashlib.sha256(encode_weights(weights)).hexdigest()
    version = f"{dataset.car.name}-{digest[:10]}"
    return replace(weights, version=version, created_utc_ns=time.time_ns())
