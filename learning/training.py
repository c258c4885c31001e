"""From samples to weights of the mean function: one GP per output of the residual.

1. Add each sample's mirror image, if the car's file says so and its samples do not contradict
   (:mod:`bayesrace.learning.symmetry`), and standardise features and targets
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

Where states are estimated, weights are conditioned on the readings of the drives instead of 4 and 5
(:mod:`bayesrace.learning.conditioning`); the metrics are still those of the samples.

Only training samples are used for any of this. The metrics in the weights are scores of the errors
held out by stretches, each stretch with a scale found on the others and without ``widen``, which is
for other driving; hyperparameters, kernel and choice of samples depend on all stretches.

:class:`Trainer` does this lap by lap in a process of its own, which leaves the CPU to everything
else.
"""

import hashlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace import __version__
from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.weights import (
    FEATURES,
    OUTPUTS,
    GpOutput,
    Weights,
    encode_weights,
    read_weights,
)
from bayesrace.integrators import Discretisation
from bayesrace.learning.change import brought_up_to_date
from bayesrace.learning.dataset import Dataset, concatenate, left_out
from bayesrace.learning.estimates import learned_in_turns
from bayesrace.learning.gaussian_process import Fit, PairDistances, maximise, refine, starts
from bayesrace.learning.settings import MIN_SAMPLES, Progress, TrainingSettings
from bayesrace.learning.subset import bounded, evenly, most_informative, spans, stretches
from bayesrace.learning.symmetry import symmetric
from bayesrace.learning.target import KernelScore, Target
from bayesrace.learning.validation import identity, residual
from bayesrace.processes import die_with_parent

__all__ = [
    "MAX_SAMPLES", "NICE", "Outcome", "Trainer", "Training", "check_samples", "fit", "perform",
    "train",
]  # fmt: skip

_log = logging.getLogger(__name__)

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

    weights: Weights
    kernels: tuple[KernelScore, ...]
    """Every candidate of every output, on the samples that hyperparameters are found with."""
    samples: Dataset
    """Learned from: the given ones, smoothed again where states are estimated."""


def train(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings | None = None,
    initial: Weights | None = None,
    progress: Progress | None = None,
) -> Weights:
    """The weights of :func:`fit`."""
    return fit(dataset, discretisation, settings, initial, progress).weights


def fit(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings | None = None,
    initial: Weights | None = None,
    progress: Progress | None = None,
) -> Training:
    """Weights that correct the discretised nominal model of the dataset's car.

    ``initial``: earlier weights of the same car and discretisation, for the model update: their
    hyperparameters are the only start of their kernels, and other candidate kernels start once.
    InputError for too few or too many samples, a column that never changes, or weights of another
    model.
    """
    settings, report = settings or TrainingSettings(), progress or (lambda share, text: None)
    widen, model = 1.0 if initial else settings.widen, identity(dataset, discretisation)
    if initial is not None and initial.discretisation != model:
        raise InputError(
            f"GP training: cannot start from weights for {initial.discretisation}, this is {model}"
        )
    if dataset.estimates is None or not dataset.estimates.drives:
        return _fit(dataset, discretisation, settings, initial, widen, report)

    def learn(samples: Dataset, before: Weights | None) -> Training:
        return _fit(samples, discretisation, settings, before, 1.0, report)

    with threadpool_limits(1, "blas"):  # threads would wait for each other
        dataset, made, found = learned_in_turns(
            dataset, discretisation, initial, learn, settings.capacity
        )
    metrics = dict(found.metrics)
    for name, output in zip(OUTPUTS, found.outputs, strict=True):
        key = f"training {name}"
        metrics[key] = {**metrics[key], "points": float(output.count)}
    return Training(_named(replace(found, metrics=metrics)), made.kernels, dataset)


def _named(weights: Weights) -> Weights:
    """Named by content: the same samples and settings always give the same version."""
    plain = replace(weights, version="unnamed", created_utc_ns=0, program="")
    digest = hashlib.sha256(encode_weights(plain)).hexdigest()
    return replace(
        plain,
        version=f"{weights.car}-{digest[:10]}",
        created_utc_ns=time.time_ns(),
        program=f"bayesrace {__version__}",
    )


def _fit(
    dataset: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings,
    initial: Weights | None,
    widen: float,
    report: Progress,
) -> Training:
    """One training on these samples; ``widen`` as in the settings."""
    model, errors = identity(dataset, discretisation), residual(dataset, discretisation)
    check_samples(dataset, errors)
    samples = dataset
    if symmetric(dataset, discretisation):
        samples = dataset.with_mirror_images()
    elif dataset.car.mirrored_samples:
        _log.warning("mirror images are left out: the car does not turn left as it turns right")
    images = len(samples) // len(dataset)
    folds = np.repeat(stretches(dataset, settings.folds), images)
    columns = residual(samples, discretisation).T, samples.deviation.T[:3]
    targets = [
        Target.of(name, samples.features, y, folds, spread)
        for name, y, spread in zip(OUTPUTS, *columns, strict=True)
    ]
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
                (chosen.covariance.noise + target.known) / chosen.covariance.signal,
                settings.capacity,
            )  # fmt: skip
            output, measured = _learned(target, chosen, kept, samples.features[kept], widen)
            outputs.append(output)
            metrics |= measured
            done = len(outputs) / len(targets)
            report(0.9 + 0.1 * done, f"{target.name}: {chosen.kind} chosen")
    checked = evenly(len(dataset), _CHECKED)
    weights = Weights(
        version="unnamed",
        car=dataset.car.name,
        discretisation=model,
        outputs=(outputs[0], outputs[1], outputs[2]),
        dataset_digest=dataset.digest(),
        metrics=metrics,
        sample_features=dataset.features[checked],
        sample_residuals=errors[checked],
    )
    return Training(_named(weights), tuple(kernels), dataset)


def check_samples(dataset: Dataset, errors: Floats) -> None:
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
    initial: Weights | None,
    report: Progress,
) -> list[list[Fit]]:
    """The best fit of each output with each kernel; several are sought at once."""
    z, limits = targets[0].z, (settings.iterations, settings.tolerance)
    some = evenly(len(z), max(MIN_SAMPLES, len(z) // _THINNED))
    pairs, few, ended = PairDistances(z), PairDistances(z[some]), threading.Event()

    def best(target: Target, kind: str, guesses: Sequence[Floats]) -> Fit:
        rough: list[Fit] = []
        y, known = target.y[some], target.known[some]
        for guess in guesses:
            if ended.is_set():
                raise InterruptedError
            rough.append(maximise(kind, few, y, guess, *limits, known=known))
        found = max(rough, key=lambda fit: fit.log_likelihood)
        return refine(pairs, target.y, found, *limits, known=target.known)

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
    errors = target.published_errors(rows, covariance)
    scale = errors.variance_scale * widen**2
    output = GpOutput(
        kernel=fit.kind,
        length_scales=covariance.lengths * target.z_scale,
        signal_variance=covariance.signal * scale,
        noise_variance=(covariance.noise + target.unknown) * scale,
        inputs=inputs,
        alpha=target.posterior(rows, covariance).alpha / scale,
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


# In a process of its own -------------------------------------------------------------------------

NICE: Final = 10
"""A tenth of what others get of a CPU. At 19 a busy machine would hardly ever run the training."""

_LONGEST_S: Final = 1800.0
"""A training without a result for so long counts as hung; one of 20,000 samples takes a minute."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a training."""

    error: str = ""
    """Why there are no weights; empty if there are."""
    weights: Weights | None = None
    samples: int = 0
    """Learned from."""
    moved: int = 0
    """Of these, from before the car has changed (:mod:`bayesrace.learning.change`)."""
    kept: Dataset | None = None
    """Kept of the samples, also where nothing can be learned from them; None if that failed."""
    training_s: float = 0.0


def perform(
    discretisation: Discretisation,
    samples: Sequence[Dataset],
    initial: Path | None,
    settings: TrainingSettings,
    keep: int,
    known: Path | None = None,
) -> Outcome:
    """Learns from samples, in the order in which they were driven, and keeps ``keep`` of them.

    ``initial``: weights to start the optimiser from; ``known``: weights of the samples before the
    newest ones, which tell whether the car has changed since. InputError if they are of another
    model or damaged. What cannot be learned is in the outcome.
    """
    begin_s, every = time.monotonic(), concatenate(samples)
    before = None if initial is None else read_weights(initial)
    weights, error, moved = None, "", 0
    try:
        present = every
        if known is not None:
            present, moved = brought_up_to_date(every, read_weights(known), discretisation)
        made = fit(present, discretisation, settings, before)
        weights, every = made.weights, made.samples
    except (InputError, ArithmeticError, ValueError) as reason:  # LinAlgError is a ValueError
        error = str(reason) or type(reason).__name__
    kept = bounded(every, keep, weights or before).settled()
    return Outcome(error, weights, len(every), moved, kept, time.monotonic() - begin_s)


class Trainer:
    """Runs one training at a time in a process, which another replaces if it has died or hangs.

    For the main thread.
    """

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._process: BaseProcess
        self._training: Future[Outcome] | None = None
        self._begin_s = 0.0

    @property
    def busy(self) -> bool:
        """A training runs, or its outcome waits for :meth:`poll`."""
        return self._training is not None

    def prepare(self) -> ProcessPoolExecutor:
        """Starts the process unless it runs: its imports take seconds."""
        if self._pool is None or not self._process.is_alive():
            spawn, others = multiprocessing.get_context("spawn"), multiprocessing.active_children()
            self._pool = ProcessPoolExecutor(1, spawn, initializer=_begin, initargs=(os.getpid(),))
            # Ctrl-C at the terminal is for the job, which ends its process.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            self._pool.submit(int)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            (self._process,) = set(multiprocessing.active_children()) - set(others)
            with suppress(ProcessLookupError):  # at once: the imports would disturb others, too
                os.setpriority(os.PRIO_PROCESS, self._process.pid or 0, NICE)
        return self._pool

    def start(self, task: Callable[[], Outcome]) -> None:
        """Calls a partial :func:`perform` in the process; only if not :attr:`busy`."""
        self._begin_s, self._training = time.monotonic(), self.prepare().submit(task)

    def poll(self) -> Outcome | None:
        """The outcome, once; None while the training runs, or without one.

        An error if the training failed, or if its process has died or hangs.
        """
        training = self._training
        if training is None or (
            not training.done() and time.monotonic() < self._begin_s + _LONGEST_S
        ):
            return None
        self._training = None
        try:
            return training.result(timeout=0)
        except TimeoutError:
            self.stop()
            return Outcome(f"the training had no result after {_LONGEST_S:.0f} s and was killed")
        except BrokenProcessPool:
            self.stop()
            code = self._process.exitcode or 0
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            return Outcome(f"the training {how}")
        except Exception as error:
            known = str(error) if isinstance(error, InputError) else ""
            return Outcome(known or f"the training failed: {type(error).__name__}: {error}")

    def stop(self) -> None:
        """Kills the process, and the training with it."""
        self._training = None
        if self._pool is not None:
            self._process.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _begin(parent: int) -> None:
    """Of the process, which ends with its parent."""
    die_with_parent(parent)
    threadpool_limits(1)  # idle threads of linear algebra would still spin against a controller
