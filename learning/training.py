"""From samples to weights of the mean function: one GP per output of the residual.

1. Add each sample's mirror image, if the car's file says so, and standardise features and targets
   (:mod:`bayesrace.learning.target`). A sample and its image are in the same stretch.
2. Per output and candidate kernel: hyperparameters by marginal likelihood, on at most
   ``hyper_points`` samples (:mod:`bayesrace.learning.gaussian_process`). Seeded starts, or given
   weights, are followed on a third of them, where an evaluation costs a tenth; the best is refined
   on all.
3. Per output: the kernel of largest log density held out by spans of the drive
   (:mod:`bayesrace.learning.subset`).
4. Factorise all samples, or the most informative ones that fit (:mod:`bayesrace.learning.subset`).
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
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace import __version__
from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, OUTPUTS, GpOutput, GpWeights, encode_weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset, left_out
from bayesrace.learning.gaussian_process import (
    Fit,
    PairDistances,
    Posterior,
    maximise,
    refine,
    starts,
)
from bayesrace.learning.settings import MIN_SAMPLES, Progress, TrainingSettings
from bayesrace.learning.subset import evenly, most_informative, spans, stretches
from bayesrace.learning.target import KernelScore, Target
from bayesrace.learning.validation import identity, residual

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
) -> Training:
    """Weights that correct the discretised nominal model of the dataset's car.

    ``initial``: earlier weights of the same car and discretisation, for the model update: their
    hyperparameters are the only start of their kernels, and other candidate kernels start once.
    InputError for too few or too many samples, a column that never changes, or weights of another
    model.
    """
    settings, report = settings or TrainingSettings(), progress or (lambda share, text: None)
    model, errors = identity(dataset, discretisation), residual(dataset, discretisation)
    if initial is not None and initial.discretisation != model:
        raise InputError(
            f"GP training: cannot start from weights for {initial.discretisation}, this is {model}"
        )
    _check(dataset, errors)
    samples = dataset.with_mirror_images() if dataset.car.mirrored_samples else dataset
    images = len(samples) // len(dataset)
    folds = np.repeat(stretches(dataset, settings.folds), images)
    columns = zip(OUTPUTS, residual(samples, discretisation).T, strict=True)
    targets = [Target.of(name, samples.features, column, folds) for name, column in columns]
    rows = evenly(len(samples), settings.hyper_points)
    if images == 2 and len(samples) >= 2 * len(rows):
        rows = rows - rows % 2 + np.arange(len(rows)) % 2  # a sample and an image in turn
    parts = spans(len(rows), settings.folds)
    subsets = [target.select(rows, parts) for target in targets]
    outputs: list[GpOutput] = []
    kernels: list[KernelScore] = []
    metrics: dict[str, dict[str, float]] = {}
    # One BLAS thread per fit: the matrices are small, and the fits run side by side.
    with threadpool_limits(1, "blas"):
        every = _optimise(subsets, settings, initial, report)
        for target, subset, fits in zip(targets, subsets, every, strict=True):
            chosen, scores = subset.choose_kernel(fits)
            kernels += scores
            kept = most_informative(
                chosen.kind, target.z, chosen.covariance.lengths,
                chosen.covariance.noise / chosen.covariance.signal, settings.capacity,
            )  # fmt: skip
            widen = 1.0 if initial is not None else settings.widen
            output, measured = _learned(target, chosen, kept, samples.features[kept], widen)
            outputs.append(output)
            metrics |= measured
            done = len(outputs) / len(targets)
            report(0.9 + 0.1 * done, f"{target.name}: {chosen.kind} chosen")
    checked = evenly(len(dataset), _CHECKED)
    weights = GpWeights(
        version="unnamed",
        car=dataset.car.name,
        discretisation=model,
        outputs=(outputs[0], outputs[1], outputs[2]),
        dataset_digest=dataset.digest(),
        metrics=metrics,
        sample_features=dataset.features[checked],
        sample_residuals=errors[checked],
    )
    # Named by content: the same samples and settings always give the same version.
    digest = hashlib.sha256(encode_weights(weights)).hexdigest()
    weights = replace(
        weights,
        version=f"{weights.car}-{digest[:10]}",
        created_utc_ns=time.time_ns(),
        program=f"bayesrace {__version__}",
    )
    return Training(weights, tuple(kernels))


def _check(dataset: Dataset, errors: Floats) -> None:
    """InputError for samples that nothing can be learned from; ``errors``: their residuals."""
    count = len(dataset)
    if not MIN_SAMPLES <= count <= MAX_SAMPLES:
        few = count < MIN_SAMPLES
        needed = f"at least {MIN_SAMPLES} are needed" if few else f"{MAX_SAMPLES} are the most"
        remedy = "drive longer" if few else "give fewer logs"
        raise InputError(
            f"GP training: {count} samples, {needed} (left out: {left_out(dataset.dropped)}); "
            f"{remedy}"
        )
    names = (*FEATURES, *(f"the residual of {output}" for output in OUTPUTS))
    for name, column in zip(names, (*dataset.features.T, *errors.T), strict=True):
        if column.std() <= _CONSTANT * max(1.0, float(np.abs(column).max())):
            fault = f"{name} is {column[0]:g} in every sample"
            raise InputError(f"GP training: {fault}: nothing to learn; vary the driving")


def _optimise(
    targets: Sequence[Target],
    settings: TrainingSettings,
    initial: GpWeights | None,
    report: Progress,
) -> list[list[Fit]]:
    """The best fit of each output with each kernel; several are sought at once."""
    z, limits = targets[0].z, (settings.iterations, settings.tolerance)
    some = evenly(len(z), max(MIN_SAMPLES, len(z) // _THINNED))
    pairs, few, ended = PairDistances(z), PairDistances(z[some]), threading.Event()

    def best(target: Target, kind: str, guesses: Sequence[Floats]) -> Fit:
        rough: list[Fit] = []
        for guess in guesses:
            if ended.is_set():
                raise InterruptedError
            rough.append(maximise(kind, few, target.y[some], guess, *limits))
        found = max(rough, key=lambda fit: fit.log_likelihood)
        return refine(pairs, target.y, found, *limits)

    usual = starts(settings.restarts if initial is None else 0, settings.seed)
    tasks = []
    for i, target in enumerate(targets):
        guesses: dict[str, list[Floats]] = dict.fromkeys(settings.kernels, usual)
        if initial is not None and all(initial.counts):
            # The kernel that suits more data may be another one: others start anew, once.
            known = initial.outputs[i]
            guesses |= {known.kernel: [target.theta_of(known)]}
        tasks += [(target, *one) for one in guesses.items()]
    pool = ThreadPoolExecutor(settings.threads or os.cpu_count() or 1)
    try:
        futures = {pool.submit(best, *task): task[0] for task in tasks}
        for done, future in enumerate(as_completed(futures), start=1):
            text = f"{futures[future].name}: {future.result().kind}"
            report(0.9 * done / len(tasks), text)
    finally:
        ended.set()  # after an interruption or a failure no other optimisation begins
        pool.shutdown(cancel_futures=True)
    return [[one.result() for one, own in futures.items() if own is target] for target in targets]


def _learned(
    target: Target, fit: Fit, rows: Rows, inputs: Floats, widen: float
) -> tuple[GpOutput, dict[str, dict[str, float]]]:
    """Factorises the samples ``rows`` with the chosen hyperparameters, calibrates the variance,
    scores the result. ``inputs``: the features of these samples in SI units."""
    covariance = fit.covariance
    errors = target.errors_from(rows, covariance)
    scale = errors.variance_scale * widen**2
    output = GpOutput(
        kernel=fit.kind,
        length_scales=covariance.lengths * target.z_scale,
        signal_variance=covariance.signal * scale,
        noise_variance=covariance.noise * scale,
        inputs=inputs,
        alpha=Posterior(covariance, target.z[rows], target.y[rows]).alpha / scale,
        y_mean=target.y_mean,
        y_scale=target.y_scale,
    )
    return output, {
        target.name: target.metrics(errors),
        f"training {target.name}": {
            "log_likelihood": fit.log_likelihood,
            "variance_scale": scale,
            "samples": float(len(target.y)),
            "points": float(len(rows)),
        },
    }
