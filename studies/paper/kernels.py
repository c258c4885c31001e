"""Error against the smoothness of the Matérn kernel (paper, appendix A)."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats, Rows
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.integrators import PREDICTION
from learning.dataset import Dataset
from learning.likelihood import PairDistances, maximise, starts
from learning.posterior import Posterior
from learning.residual import residual
from learning.target import Target
from operation.report.canvas import panel
from operation.report.style import look
from operation.terminal.notation import SMOOTHNESS, SYMBOLS
from operation.terminal.progress import Stage
from studies.paper.experiment import stored
from studies.paper.finding import Finding, Section

__all__ = ["Smoothness", "kernel_section", "smoothness"]

_FORMS: Final = {"isotropic": look("worstcase").colour, "ARD": look("bayesrace").colour}
_ITERATIONS: Final = 100
_PAPERS: Final = "rbf"
"""The paper's choice for its 1:43 car: nu to infinity."""
_CRITERION: Final = "RBF is the best, or worse by less than the standard deviation over the seeds"
_OTHERS: Final = (
    "the published residuals mix integrators and their noise is fixed; ours are made with the "
    "integrator of the controller, and their noise is learned"
)


class Smoothness(NamedTuple):
    """RMSE on BestCase's lap (forms, kernels, seeds, outputs), SI units."""

    name: str
    rmse: Floats


def smoothness(
    name: str, training: Dataset, test: Dataset, points: int, seeds: int, stage: Stage
) -> Smoothness:
    """GPs of every kernel, each seed on ``points`` samples that it draws.

    The errors of each kernel are kept as soon as they are known.
    """
    draws, count = map(np.random.default_rng, range(seeds)), min(points, len(training))
    rows = [np.sort(one.choice(len(training), count, replace=False)) for one in draws]
    found: list[object] = []
    for isotropic, (kind, nu) in product((True, False), SMOOTHNESS.items()):
        stage.update(len(found) / (len(_FORMS) * len(SMOOTHNESS)), f"ν = {nu}")
        key = training.digest(), test.digest(), f"{kind} {isotropic} {count} {seeds}"
        make = partial(_errors, kind, isotropic, training, test, rows)
        found.append(stored("smoothness", key, make))
    shape = len(_FORMS), len(SMOOTHNESS), seeds, len(OUTPUTS)
    return Smoothness(name, np.array(found, dtype=np.float64).reshape(shape))


def _errors(
    kind: str, isotropic: bool, training: Dataset, test: Dataset, rows: Sequence[Rows]
) -> list[float]:
    """RMSE of each seed and output, one seed after the other."""
    (start,) = starts(0, 0)
    learned, truth = residual(training, PREDICTION), residual(test, PREDICTION)

    def error(seed: int, output: int) -> float:
        own, features = rows[seed], training.features[rows[seed]]
        target = Target.of(OUTPUTS[output], features, learned[own, output], own)
        pairs = PairDistances(target.z)
        found = maximise(kind, pairs, target.y, start, _ITERATIONS, isotropic=isotropic)
        # A kernel sees differences of features alone: no mean need be subtracted.
        known, unseen = features / target.z_scale, test.features / target.z_scale
        mean, _ = Posterior(found.covariance, known, target.y).predict(unseen)
        left = truth[:, output] - target.y_mean - target.y_scale * mean
        return float(np.sqrt(np.mean(left**2)))

    seeds, outputs = np.indices((len(rows), len(OUTPUTS))).reshape(2, -1).tolist()
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(os.cpu_count()) as pool:
        return [*pool.map(error, seeds, outputs)]


def kernel_section(every: Sequence[Smoothness], points: int) -> Section:
    """A panel for each output and drive."""
    seeds = every[0].rmse.shape[2]
    text = (
        "RMSE on BestCase's lap of GPs with Matérn kernels of growing smoothness ν, with one "
        "length scale for all features (isotropic) or one for each (ARD). Line and band: mean and "
        f"range over {seeds} seeds, each of which draws {points} samples of the training drive."
    )
    both = [(one, output) for one in every for output in range(len(OUTPUTS))]
    figures = {f"smoothness-{OUTPUTS[i]}-{one.name}": _figure(one, i) for one, i in both}
    findings = [_finding(one, output) for one, output in both]
    return Section("Smoothness of the kernel", "appendix A", text, figures, findings)


def _figure(one: Smoothness, output: int) -> Figure:
    figure, axes = panel(2.5)
    places, name = np.arange(len(SMOOTHNESS)), OUTPUTS[output]
    for (form, colour), rmse in zip(_FORMS.items(), one.rmse[..., output], strict=True):
        low, high = rmse.min(axis=1), rmse.max(axis=1)
        axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(places, rmse.mean(axis=1), "o-", color=colour, markersize=4, label=form)
    axes.set_xticks(places, list(SMOOTHNESS.values()))
    axes.set(xlabel="smoothness ν", ylabel=f"RMSE [{UNITS[name]}]", ylim=(0, None))
    axes.set_title(f"{SYMBOLS[name]}, {one.name} data")
    axes.legend(loc="best")
    return figure


def _finding(one: Smoothness, output: int) -> Finding:
    """The paper's kernel is not worse than the best one by more than the seeds differ."""
    rmse, name = one.rmse[0, :, :, output], OUTPUTS[output]
    mean, kernels = rmse.mean(axis=1), list(SMOOTHNESS)
    best, papers = int(np.argmin(mean)), kernels.index(_PAPERS)
    size = (f"{SMOOTHNESS[kernels[i]]}: {mean[i]:.3g} {UNITS[name]}" for i in (best, papers))
    holds = bool(mean[papers] - mean[best] <= float(np.std(rmse[papers] - rmse[best])))
    what = f"best ν for {SYMBOLS[name]}, isotropic, {one.name} data"
    return Finding(what, "∞ (RBF)", "; ".join(size), _CRITERION, holds, _OTHERS)
