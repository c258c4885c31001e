"""Training against scikit-learn: the same samples, kernel, starts and bounds.

    python benchmarks/training.py [--points 800] [--restarts 4] [--kernel rbf] [--seed 0]

scikit-learn's ``GaussianProcessRegressor`` optimises one start after another with its own L-BFGS-B
and tolerances, on as many BLAS threads as it likes. Ours is all of ``learning.training.fit``:
optimisation, factorisation, cross-validation. Both start from the same points within the same
bounds; the best log marginal likelihood per output is compared. Takes minutes, nearly all of them
scikit-learn's. The samples are those of the pure-pursuit drive that every race begins with, each
with its mirror image, for both.
"""

import argparse
import math
import os
import time
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS
from bayesrace.integrators import PREDICTION
from learning.hyperparameters import BOUNDS, starts
from learning.residual import residual
from learning.settings import TrainingSettings
from learning.target import Target
from learning.training import fit
from operation.preparation import training_samples
from operation.settings import PreparationSettings

NU = {"matern05": 0.5, "matern15": 1.5, "matern25": 2.5}
SLACK = 1e-3
"""Log marginal likelihoods closer than this are the same optimum."""


def theirs(kind: str, start: Floats, z: Floats, y: Floats) -> float:
    """scikit-learn's log marginal likelihood from one start."""
    low, high = np.exp(BOUNDS).T
    theta = np.exp(np.clip(start, BOUNDS[:, 0], BOUNDS[:, 1]))
    lengths = {"length_scale": theta[1:-1], "length_scale_bounds": np.exp(BOUNDS[1:-1])}
    base = RBF(**lengths) if kind == "rbf" else Matern(nu=NU[kind], **lengths)
    signal = ConstantKernel(theta[0], (low[0], high[0]))
    kernel = signal * base + WhiteKernel(theta[-1], (low[-1], high[-1]))
    gp = GaussianProcessRegressor(kernel, alpha=0.0, optimizer="fmin_l_bfgs_b")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # that a parameter ends at its bound
        return float(gp.fit(z, y).log_marginal_likelihood_value_)


def clocks() -> Floats:
    """Time and CPU time of all threads [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def main() -> None:
    """Runs both and prints times, optima and the ratio."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=800, help="with the mirror images")
    parser.add_argument("--restarts", type=int, default=4)
    parser.add_argument("--kernel", choices=("rbf", *NU), default="rbf")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    points, kind = arguments.points, arguments.kernel

    duration_s = (points // 2 + 5) * PREDICTION.step_s
    settings = PreparationSettings(collect_s=duration_s, seed=arguments.seed)
    assert settings.car.mirrored_samples, "fit() would learn without the images"
    samples = training_samples(settings).select(slice(points // 2))
    learned = samples.with_mirror_images()
    assert len(learned) == points, f"{len(learned)} samples, not {points}"
    options = TrainingSettings(
        kernels=(kind,),
        restarts=arguments.restarts,
        seed=arguments.seed,
        hyper_points=points,
        capacity=max(points, 1024),
        iterations=1000,
    )
    guesses = starts(arguments.restarts, arguments.seed)
    print(
        f"{points} samples, {kind}, {len(guesses)} starts, {len(OUTPUTS)} outputs, "
        f"{os.cpu_count()} cores"
    )
    began = clocks()
    weights = fit(samples, PREDICTION, options).weights
    ours_s = clocks() - began
    ours = [weights.metrics[f"training {output}"]["log_likelihood"] for output in OUTPUTS]
    print("ours, all of training: {:.2f} s, CPU {:.2f} s".format(*ours_s))

    z, y = learned.features, residual(learned, PREDICTION)
    theirs_s, same = np.zeros(2), True
    for i, output in enumerate(OUTPUTS):
        target = Target.of(output, z, y[:, i], np.zeros(points, dtype=np.int64))
        found = -math.inf
        began = clocks()
        for guess in guesses:
            found = max(found, theirs(kind, guess, target.z, target.y))
        theirs_s += clocks() - began
        same &= abs(ours[i] - found) <= SLACK
        print(f"{output:6} ours {ours[i]:.5f}, scikit-learn {found:.5f}: {ours[i] - found:+.1e}")
    print("scikit-learn, optimisation alone: {:.2f} s, CPU {:.2f} s".format(*theirs_s))
    ratio = "{:.1f} times as fast, by CPU time {:.1f}".format(*(theirs_s / ours_s))
    print(f"{ratio}; {'the same optima' if same else 'OTHER OPTIMA'}")


if __name__ == "__main__":
    main()
