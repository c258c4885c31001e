"""From samples to mean-function weights: one GP per output of the residual.

1. Standardise features and targets, once (scikit-learn's own ``normalize_y`` stays off).
2. Per output and candidate kernel: hyperparameters by marginal likelihood from seeded starts, or
   from given weights (:mod:`learning.hyperparameters`), on at most ``hyper_points`` samples.
3. Per output: the kernel of largest log density held out by spans of the drive
   (:mod:`learning.folds`, :mod:`learning.crossvalidation`).
4. Factorise with scikit-learn on all samples, or on the most informative ones that fit.
5. Scale all variances so that the 95 % interval holds 95 % of the errors held out by stretches of
   the track, if it held less. The mean does not change. A likelihood that finds the data
   noise-free and smooth is over-confident when the model is not quite right; setting the variance
   by cross-validation is the known remedy (Bachoc, "Cross validation and maximum likelihood
   estimations of hyper-parameters of Gaussian processes with model misspecification", CSDA 2013).

Only training samples are used for any of this. The metrics that the weights carry are those of the
errors held out by stretches, each stretch with a scale found on the others; hyperparameters, kernel
and choice of samples have seen all stretches.
"""

import hashlib
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from threadpoolctl import threadpool_limits

from bayesrace import __version__
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, OUTPUTS, GpOutput, GpWeights, encode_weights
from bayesrace.integrators import Discretisation
from learning.assessment import TESTS, ChoiceScore, KernelScore, choice_scores
from learning.crossvalidation import calibrated
from learning.dataset import Dataset, left_out
from learning.folds import spans, stretches
from learning.hyperparameters import TOLERANCE, Fit, best, maximise, starts
from learning.likelihood import PairDistances
from learning.regression import Scaling, held_out_errors, judged, regressor, scaling_of
from learning.residual import identity, residual
from learning.subset import evenly, most_informative

__all__ = [
    "MAX_SAMPLES",
    "MIN_SAMPLES",
    "Progress",
    "Training",
    "TrainingSettings",
    "fit",
    "train",
]

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Kernel = Literal["rbf", "matern05", "matern15", "matern25"]

Progress = Callable[[float, str], None]
"""Called from the training's own thread with the share done (0 to 1) and what was done."""

MIN_SAMPLES: Final = 20

_CONSTANT: Final = 1e-9
"""A column whose standard deviation is below this share of its size never changes."""

MAX_SAMPLES: Final = 100_000
"""Choosing among more would take gigabytes."""


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
    tolerance: float = Field(
        default=TOLERANCE, gt=0, lt=1, description="relative gain at which the optimiser stops"
    )
    iterations: int = Field(default=100, ge=1, description="optimiser iterations per start")
    warm_iterations: int = Field(
        default=30, ge=1, description="the same, starting from given weights"
    )
    folds: int = Field(
        default=10, ge=2, description="parts of the drive, or of the track, each held out in turn"
    )
    threads: int = Field(default=0, ge=0, description="parallel fits; 0 is one per core")


def _theta_of(output: GpOutput, scaling: Scaling) -> Floats:
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
    settings: TrainingSettings, scalings: Sequence[Scaling], initial: GpWeights | None
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
    tasks: Sequence[_Task],
    z: Floats,
    targets: Sequence[Floats],
    settings: TrainingSettings,
    report: Progress,
) -> list[Fit]:
    """All optimisations, several at once, results in the order of the tasks."""
    pairs = PairDistances(z)
    pool = ThreadPoolExecutor(settings.threads or os.cpu_count() or 1)
    try:
        futures = {
            pool.submit(
                maximise, t.kind, pairs, targets[t.output], t.start, t.iterations,
                settings.tolerance,
            ): t
            for t in tasks
        }  # fmt: skip
        for done, future in enumerate(as_completed(futures), start=1):
            task = futures[future]
            future.result()
            report(0.9 * done / len(tasks), f"{OUTPUTS[task.output]}: {task.kind}")
    finally:
        # Interrupted, or failed: what has not begun is not worth waiting for.
        pool.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


def _choose(
    output: str, fits: Sequence[Fit], z: Floats, y: Floats, folds: int, scale: float
) -> tuple[Fit, list[KernelScore]]:
    """Best start per kernel by likelihood, then best kernel by held-out log density."""
    kinds = list(dict.fromkeys(fit.kind for fit in fits))
    candidates = [best([fit for fit in fits if fit.kind == kind]) for kind in kinds]
    parts = spans(len(y), folds)
    held = [held_out_errors(regressor(c.kind, c.theta, z, y), y, parts) for c in candidates]
    chosen = max(range(len(candidates)), key=lambda i: held[i].log_density)
    scores = [
        KernelScore.of(output, candidate, errors, scale, i == chosen)
        for i, (candidate, errors) in enumerate(zip(candidates, held, strict=True))
    ]
    return candidates[chosen], scores


def _finish(
    name: str,
    fit: Fit,
    scaling: Scaling,
    z_raw: Floats,
    y: Floats,
    folds: Rows,
    settings: TrainingSettings,
    compare: bool,
) -> tuple[GpOutput, dict[str, dict[str, float]], list[ChoiceScore]]:
    """Factorises with the chosen hyperparameters, calibrates the variance, judges the result."""
    signal, noise = math.exp(fit.theta[0]), math.exp(fit.theta[-1])
    z, lengths = scaling.features(z_raw), np.exp(fit.theta[1:-1])
    rows = most_informative(fit.kind, z, lengths, noise / signal, settings.capacity)
    gp = regressor(fit.kind, fit.theta, z[rows], y[rows])
    tests = evenly(len(y), TESTS)
    errors = judged(fit.kind, fit.theta, z, y, rows, tests, folds)
    scale = errors.variance_scale
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
    held = calibrated(errors, folds[tests])
    metrics = {
        name: held.metrics(y[tests], scaling.y_mean, scaling.y_scale),
        f"training {name}": {
            "log_likelihood": fit.log_likelihood,
            "variance_scale": scale,
            "samples": float(len(y)),
            "points": float(len(rows)),
        },
    }
    choices = []
    if compare and len(rows) < len(y):
        choices = choice_scores(name, fit, z, y, rows, folds, settings.seed, scaling.y_scale)
    return output, metrics, choices


def _check(dataset: Dataset) -> None:
    """InputError for samples that nothing can be learned from."""
    count = len(dataset)
    if not MIN_SAMPLES <= count <= MAX_SAMPLES:
        few = count < MIN_SAMPLES
        needed = f"at least {MIN_SAMPLES} are needed" if few else f"{MAX_SAMPLES} are the most"
        remedy = "drive longer" if few else "give fewer logs"
        raise InputError(
            f"GP training: {count} samples, {needed} (left out: {left_out(dataset.dropped)}); "
            f"{remedy}"
        )
    _check_columns(dataset.features, FEATURES, "{} is {:g} in every sample; vary it while driving")


def _check_columns(columns: Floats, names: Sequence[str], text: str) -> None:
    for name, column in zip(names, columns.T, strict=True):
        if column.std() <= _CONSTANT * max(1.0, float(np.abs(column).max())):
            raise InputError("GP training: " + text.format(name, float(column[0])))


def _named(weights: GpWeights) -> GpWeights:
    """Named by content: the same samples and settings give the same version, whoever trains."""
    digest = hashlib.sha256(encode_weights(weights)).hexdigest()
    return replace(
        weights,
        version=f"{weights.car}-{digest[:10]}",
        created_utc_ns=time.time_ns(),
        program=f"bayesrace {__version__}",
    )


@dataclass(frozen=True, eq=False)
class Training:
    """Weights, and how they came about."""

    weights: GpWeights
    kernels: tuple[KernelScore, ...]
    """Every candidate of every output, on the samples that hyperparameters are found with."""
    choices: tuple[ChoiceScore, ...]
    """What choosing samples costs; empty if all fit, or if nobody asked."""


def train(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings | None = None,
    initial: GpWeights | None = None,
    progress: Progress | None = None,
) -> GpWeights:
    """The weights of :func:`fit`."""
    return fit(dataset, discretisation, settings, initial, progress).weights


def fit(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings | None = None,
    initial: GpWeights | None = None,
    progress: Progress | None = None,
    compare: bool = False,
) -> Training:
    """Weights that correct the discretised nominal model of the dataset's car.

    ``initial``: earlier weights of the same car and discretisation, for the model update: their
    hyperparameters are refined instead of searched anew, and other candidate kernels start once.
    ``compare``: also measure what it costs to learn from chosen samples instead of all.
    InputError for too few or too many samples, a column that never changes, or weights of another
    model.
    """
    settings, report = settings or TrainingSettings(), progress or (lambda share, text: None)
    name = identity(dataset, discretisation)
    _check(dataset)
    if initial is not None and initial.discretisation != name:
        raise InputError(
            f"GP training: cannot start from weights for {initial.discretisation}, this is {name}"
        )
    z, y = dataset.features, residual(dataset, discretisation)
    _check_columns(y, OUTPUTS, "the residual of {} is {:g} in every sample: nothing to learn")
    scalings = [scaling_of(z, column) for column in y.T]
    targets = [s.targets(column) for s, column in zip(scalings, y.T, strict=True)]
    rows, folds = evenly(len(z), settings.hyper_points), stretches(dataset, settings.folds)
    subset, subset_targets = scalings[0].features(z)[rows], [column[rows] for column in targets]
    tasks = _tasks(settings, scalings, initial)
    outputs: list[GpOutput] = []
    kernels: list[KernelScore] = []
    choices: list[ChoiceScore] = []
    metrics: dict[str, dict[str, float]] = {}
    # One BLAS thread per fit: the matrices are small, and the fits run side by side.
    with threadpool_limits(1, "blas"):
        fits = _run(tasks, subset, subset_targets, settings, report)
        for i, label in enumerate(OUTPUTS):
            own = [fit for fit, task in zip(fits, tasks, strict=True) if task.output == i]
            chosen, scores = _choose(
                label, own, subset, subset_targets[i], settings.folds, scalings[i].y_scale
            )
            output, measured, costs = _finish(
                label, chosen, scalings[i], z, targets[i], folds, settings, compare
            )
            outputs.append(output)
            kernels += scores
            choices += costs
            metrics |= measured
            report(0.9 + 0.1 * (i + 1) / len(OUTPUTS), f"{label}: {chosen.kind} chosen")
    weights = GpWeights(
        version="unnamed",
        car=dataset.car.name,
        discretisation=name,
        outputs=(outputs[0], outputs[1], outputs[2]),
        dataset_digest=dataset.digest(),
        metrics=metrics,
    )
    return Training(_named(weights), tuple(kernels), tuple(choices))
