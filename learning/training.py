"""From samples to weights of the mean function: one GP per output of the residual.

1. Add each sample's mirror image, if the car's file says so, and standardise features and targets
   (:mod:`learning.target`). A sample and its image are in the same stretch.
2. Per output and candidate kernel: hyperparameters by marginal likelihood
   (:mod:`learning.hyperparameters`) on at most ``hyper_points`` samples. Seeded starts, or given
   weights, are followed on a third of them, where an evaluation costs a tenth; the best is refined
   on all.
3. Per output: the kernel of largest log density held out by spans of the drive
   (:mod:`learning.folds`, :mod:`learning.assessment`).
4. Factorise all samples, or the most informative ones that fit (:mod:`learning.subset`).
5. Scale all variances so that the 95 % interval holds 95 % of the errors held out by stretches of
   the track, if it held less. The mean does not change. A likelihood that finds the data
   noise-free and smooth is over-confident when the model is not quite right; setting the variance
   by cross-validation is the known remedy (Bachoc, "Cross validation and maximum likelihood
   estimations of hyper-parameters of Gaussian processes with model misspecification", CSDA 2013).

Only training samples are used for any of this. The metrics in the weights are scores of the errors
held out by stretches, each stretch with a scale found on the others and without ``widen``, which is
for other driving; hyperparameters, kernel and choice of samples depend on all stretches.
"""

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace import __version__
from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, OUTPUTS, GpOutput, GpWeights, encode_weights
from bayesrace.integrators import Discretisation
from learning.assessment import ChoiceScore, KernelScore, choice_scores, choose_kernel
from learning.dataset import Dataset, left_out
from learning.folds import spans, stretches
from learning.hyperparameters import Fit, maximise, refine, starts
from learning.likelihood import PairDistances
from learning.posterior import Posterior
from learning.residual import identity, residual
from learning.settings import MIN_SAMPLES, Progress, TrainingSettings
from learning.subset import evenly, most_informative
from learning.target import Target

__all__ = ["MAX_SAMPLES", "Training", "fit", "train"]

MAX_SAMPLES: Final = 100_000
"""Choosing among more would take gigabytes."""

_CONSTANT: Final = 1e-9
"""A column whose standard deviation is below this share of its size never changes."""

_THINNED: Final = 3
"""One in so many samples shows where the optimum is."""

_CHECKED: Final = 200
"""Samples that go with the weights, for a controller to check them by."""


@dataclass(frozen=True, eq=False)
class Training:
    """Weights, and the scores that led to them."""

    weights: GpWeights
    kernels: tuple[KernelScore, ...]
    """Every candidate of every output, on the samples that hyperparameters are found with."""
    choices: tuple[ChoiceScore, ...]
    """The cost of choosing samples; empty if all fit, or without ``compare``."""


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
    hyperparameters are the only start of their kernels, and other candidate kernels start once.
    ``compare``: also measure what it costs to learn from chosen samples instead of all.
    InputError for too few or too many samples, a column that never changes, or weights of another
    model.
    """
    settings, report = settings or TrainingSettings(), progress or (lambda share, text: None)
    model = identity(dataset, discretisation)
    if initial is not None and initial.discretisation != model:
        raise InputError(
            f"GP training: cannot start from weights for {initial.discretisation}, this is {model}"
        )
    _check(dataset, discretisation)
    samples = dataset.with_mirror_images() if dataset.car.mirrored_samples else dataset
    targets = _targets(samples, discretisation, stretches(dataset, settings.folds))
    rows = evenly(len(samples), settings.hyper_points)
    if dataset.car.mirrored_samples and len(samples) >= 2 * len(rows):
        rows = rows - rows % 2 + np.arange(len(rows)) % 2  # a sample and an image in turn
    parts = spans(len(rows), settings.folds)
    subsets = [target.select(rows, parts) for target in targets]
    outputs: list[GpOutput] = []
    kernels: list[KernelScore] = []
    choices: list[ChoiceScore] = []
    metrics: dict[str, dict[str, float]] = {}
    # One BLAS thread per fit: the matrices are small, and the fits run side by side.
    with threadpool_limits(1, "blas"):
        fits = _optimise(subsets, settings, initial, report)
        for i, target in enumerate(targets):
            chosen, scores = choose_kernel(subsets[i], fits[i])
            output, measured, costs = _finish(
                target, chosen, samples.features, settings, compare, first=initial is None
            )
            outputs.append(output)
            kernels += scores
            choices += costs
            metrics |= measured
            report(0.9 + 0.1 * (i + 1) / len(targets), f"{target.name}: {chosen.kind} chosen")
    checked = evenly(len(dataset), _CHECKED)
    weights = GpWeights(
        version="unnamed",
        car=dataset.car.name,
        discretisation=model,
        outputs=(outputs[0], outputs[1], outputs[2]),
        dataset_digest=dataset.digest(),
        metrics=metrics,
        sample_features=dataset.features[checked],
        sample_residuals=residual(dataset, discretisation)[checked],
    )
    return Training(_named(weights), tuple(kernels), tuple(choices))


def _check(dataset: Dataset, discretisation: Discretisation) -> None:
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
    z, y = dataset.features, residual(dataset, discretisation)
    names = (*FEATURES, *(f"the residual of {output}" for output in OUTPUTS))
    for name, column in zip(names, (*z.T, *y.T), strict=True):
        if column.std() <= _CONSTANT * max(1.0, float(np.abs(column).max())):
            fault = f"{name} is {column[0]:g} in every sample"
            raise InputError(f"GP training: {fault}: nothing to learn; vary the driving")


def _targets(samples: Dataset, discretisation: Discretisation, parts: Rows) -> list[Target]:
    """One target per output; ``parts``: the fold of each sample, and of its mirror image."""
    folds = np.repeat(parts, len(samples) // len(parts))
    columns = zip(OUTPUTS, residual(samples, discretisation).T, strict=True)
    return [Target.of(name, samples.features, column, folds) for name, column in columns]


def _starts(
    target: Target, settings: TrainingSettings, initial: GpOutput | None
) -> dict[str, list[Floats]]:
    """Where the optimisations for one output start, by kernel."""
    guesses = starts(settings.restarts if initial is None else 0, settings.seed)
    every: dict[str, list[Floats]] = dict.fromkeys(settings.kernels, guesses)
    # The kernel that suits more data may be another one: those not in use start anew, once.
    return every if initial is None else every | {initial.kernel: [target.theta_of(initial)]}


def _optimise(
    targets: Sequence[Target],
    settings: TrainingSettings,
    initial: GpWeights | None,
    report: Progress,
) -> list[list[Fit]]:
    """The fits of each output, one for each kernel."""
    known = (
        initial.outputs if initial is not None and all(initial.counts) else [None] * len(targets)
    )
    z = targets[0].z
    some = evenly(len(z), max(MIN_SAMPLES, len(z) // _THINNED))
    pairs, few = PairDistances(z), PairDistances(z[some])
    limits = settings.iterations, settings.tolerance
    rough = [
        (target.name, partial(maximise, kind, few, target.y[some], start, *limits))
        for target, output in zip(targets, known, strict=True)
        for kind, guesses in _starts(target, settings, output).items()
        for start in guesses
    ]
    best: dict[tuple[str, str], Fit] = {}
    found = _side_by_side(rough, settings, lambda share, text: report(0.4 * share, text))
    for (name, _), fit in zip(rough, found, strict=True):
        best[name, fit.kind] = max(
            best.get((name, fit.kind), fit), fit, key=lambda one: one.log_likelihood
        )
    y = {target.name: target.y for target in targets}
    fine = [
        (name, partial(refine, pairs, y[name], fit, *limits)) for (name, _), fit in best.items()
    ]
    found = _side_by_side(fine, settings, lambda share, text: report(0.4 + 0.5 * share, text))
    return [
        [fit for (name, _), fit in zip(fine, found, strict=True) if name == target.name]
        for target in targets
    ]


def _side_by_side(
    tasks: Sequence[tuple[str, Callable[[], Fit]]], settings: TrainingSettings, report: Progress
) -> list[Fit]:
    """What the optimisations find, each with the name of its output; several run at once."""
    pool = ThreadPoolExecutor(settings.threads or os.cpu_count() or 1)
    try:
        futures = {pool.submit(task): name for name, task in tasks}
        for done, future in enumerate(as_completed(futures), start=1):
            report(done / len(tasks), f"{futures[future]}: {future.result().kind}")
    finally:
        # After an interruption or a failure no other optimisation begins.
        pool.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


def _finish(
    target: Target,
    fit: Fit,
    inputs: Floats,
    settings: TrainingSettings,
    compare: bool,
    first: bool,
) -> tuple[GpOutput, dict[str, dict[str, float]], list[ChoiceScore]]:
    """Factorises with the chosen hyperparameters, calibrates the variance, scores the result."""
    covariance = fit.covariance
    noise_ratio = covariance.noise / covariance.signal
    rows = most_informative(fit.kind, target.z, covariance.lengths, noise_ratio, settings.capacity)
    alpha = Posterior(covariance, target.z[rows], target.y[rows]).alpha
    errors = target.errors_from(rows, covariance)
    scale = errors.variance_scale * (settings.widen**2 if first else 1.0)
    output = GpOutput(
        kernel=fit.kind,
        length_scales=covariance.lengths * target.z_scale,
        signal_variance=covariance.signal * scale,
        noise_variance=covariance.noise * scale,
        inputs=inputs[rows],
        alpha=alpha / scale,
        y_mean=target.y_mean,
        y_scale=target.y_scale,
    )
    metrics = {
        target.name: target.metrics(target.calibrated(errors)),
        f"training {target.name}": {
            "log_likelihood": fit.log_likelihood,
            "variance_scale": scale,
            "samples": float(len(target.y)),
            "points": float(len(rows)),
        },
    }
    choose = compare and len(rows) < len(target.y)
    choices = choice_scores(target, covariance, rows, settings.seed) if choose else []
    return output, metrics, choices


def _named(weights: GpWeights) -> GpWeights:
    """Named by content: the same samples and settings always give the same version."""
    digest = hashlib.sha256(encode_weights(weights)).hexdigest()
    return replace(
        weights,
        version=f"{weights.car}-{digest[:10]}",
        created_utc_ns=time.time_ns(),
        program=f"bayesrace {__version__}",
    )
