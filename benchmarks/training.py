"""Training against scikit-learn: the same samples, kernel, starts and bounds.

    python -m benchmarks.training [--points 800] [--restarts 4] [--kernel rbf] [--seed 0]

scikit-learn's ``GaussianProcessRegressor`` optimises one start after another with its own L-BFGS-B
and tolerances, on as many BLAS threads as it likes. Ours is all of
``bayesrace.learning.training.fit``: optimisation, factorisation, cross-validation. The samples are
those of the pure-pursuit drive that every race begins with, each with its mirror image. Takes
minutes, nearly all scikit-learn's.
"""

import time
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS
from bayesrace.integrators import PREDICTION
from bayesrace.learning.likelihood import BOUNDS, starts
from bayesrace.learning.residual import residual
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.target import Target
from bayesrace.learning.training import fit
from bayesrace.operation.preparation import training_samples
from bayesrace.operation.settings import PreparationSettings
from benchmarks.harness import Row, arguments, report
from tests.scikit import scikit_gp


def clocks() -> Floats:
    """Time and CPU time [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def main() -> None:
    """Trains by both, prints times and optima."""
    warnings.simplefilter("ignore", ConvergenceWarning)  # that a parameter ends at its bound
    given = arguments(__doc__, points=800, restarts=4, kernel="rbf", seed=0)
    points, seed = given.points, given.seed
    drive = PreparationSettings(collect_s=(points // 2 + 5) * PREDICTION.step_s, seed=seed)
    samples = training_samples(drive).select(slice(points // 2))
    learned = samples.with_mirror_images()
    assert len(learned) == points, f"{len(learned)} samples, not {points}"
    settings = TrainingSettings(
        kernels=(given.kernel,), restarts=given.restarts, seed=seed, hyper_points=points,
        capacity=max(points, 1024), iterations=1000,
    )  # fmt: skip
    begun = clocks()
    weights = fit(samples, PREDICTION, settings).weights
    ours_s, theirs_s = clocks() - begun, np.zeros(2)
    z, y = learned.features, residual(learned, PREDICTION)
    rows: list[Row] = []
    for i, output in enumerate(OUTPUTS):
        target = Target.of(output, z, y[:, i], np.zeros(len(z), dtype=np.int64))
        begun, found = clocks(), []
        for start in np.clip(starts(given.restarts, seed), *BOUNDS.T):
            gp = scikit_gp(given.kernel, start, target.z, target.y, BOUNDS)
            found.append(float(gp.log_marginal_likelihood_value_))
        theirs_s += clocks() - begun
        own, best = weights.metrics[f"training {output}"]["log_likelihood"], max(found)
        both = {"ours": own, "scikit-learn": best, "less, or times as fast": own - best}
        rows.append({"": f"log likelihood, {output}", **both})
    for i, name in enumerate(("time [s]", "CPU time [s]")):
        times = {"ours": float(ours_s[i]), "scikit-learn": float(theirs_s[i])}
        rows.append({"": name, **times, "less, or times as fast": float(theirs_s[i] / ours_s[i])})
    report(given, f"{points} samples, {given.kernel}, {len(OUTPUTS)} outputs", rows)


if __name__ == "__main__":
    main()
