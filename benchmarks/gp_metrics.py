"""The metrics in weights beside those on drives that they were not learned from.

    python -m benchmarks.gp_metrics [--quick]

Drives of the Orca: training drives of 150 to 1200 samples on five tracks, and one and three laps
of its MPC, corrected by the weights of the default training drive, on each. From each drive weights
are learned, no less sure than the drive alone says (``widen`` 1). Their metrics (held out by
stretches of the track, and by spans of time) are compared with those on drives elsewhere.

First the two examples of docs/learning.md, omega alone; then means and standard deviations over all
weights, other tracks and outputs. ``--quick``: the examples alone.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import PREDICTION
from bayesrace.raceline.cached import racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from benchmarks.spoilt_weights import learned
from codegen.build import build
from codegen.settings import BuildSettings
from learning.dataset import Dataset
from learning.folds import spans
from learning.posterior import Covariance
from learning.residual import residual
from learning.settings import TrainingSettings
from learning.subset import most_informative
from learning.target import Target
from learning.training import train
from learning.validation import validate
from operation.closed_loop import drive_compiled
from operation.preparation import training_samples
from operation.settings import PreparationSettings

CAR: Final = get_car("orca")
TRACKS: Final = "paddock", "harbour", "random:3", "random:5", "random:8"
SAMPLES: Final = 150, 300, 600, 1200
LAPS: Final = 1, 3
SETTINGS: Final = TrainingSettings(widen=1.0)

Metrics = Mapping[str, Mapping[str, float]]


class Drive(NamedTuple):
    """Samples of a driver on a track."""

    driver: str
    track: str
    samples: Dataset


def pursuit(track: str, samples: int, seed: int = 0) -> Drive:
    """A training drive, cut to so many samples."""
    seconds = (samples + 5) * PREDICTION.step_s
    settings = PreparationSettings(car=CAR, train_track=track, collect_s=seconds, seed=seed)
    return Drive("pure pursuit", track, training_samples(settings).select(slice(samples)))


def mpc(track: str, laps: int, weights: GpWeights) -> Drive:
    """Laps of the compiled controller from a standing start."""
    driven_on = load_track(track, CAR.width_m)
    artefact = build(BuildSettings(car=CAR))[0]
    line = racing_line(driven_on, CAR)
    run = drive_compiled(artefact, driven_on, line, weights, car=CAR, laps=laps)
    return Drive("MPC laps", track, run.samples())


def measured(weights: GpWeights, on: Drive) -> Metrics:
    """Metrics of weights on a drive."""
    return validate(weights, on.samples, PREDICTION).metrics


def by_time(weights: GpWeights, samples: Dataset) -> Metrics:
    """As the weights report them, but held out by spans of time."""
    z, y = samples.features, residual(samples, PREDICTION)
    found: dict[str, Mapping[str, float]] = {}
    parts = spans(len(samples), 10)
    for i, (name, output) in enumerate(zip(OUTPUTS, weights.outputs, strict=True)):
        target = Target.of(name, z, y[:, i], parts)
        scale = np.log(weights.metrics[f"training {name}"]["variance_scale"])
        theta = target.theta_of(output) - scale * np.array([1, 0, 0, 0, 0, 0, 0, 1])
        covariance = Covariance.of(output.kernel, theta)
        ratio, count = covariance.noise / covariance.signal, len(output.inputs)
        rows = most_informative(output.kernel, target.z, covariance.lengths, ratio, count)
        found[name] = target.metrics(target.calibrated(target.errors_from(rows, covariance)))
    return found


def example(name: str, drive: Drive, others: Iterable[tuple[str, Callable[[], Drive]]]) -> None:
    """Omega of the weights of one drive, reported and elsewhere."""
    weights = train(drive.samples, PREDICTION, SETTINGS)
    rows = [("reported in the weights", weights.metrics)]
    rows.append(("the same, held out by time", by_time(weights, drive.samples)))
    rows += [(where, measured(weights, make())) for where, make in others]
    print(f"{name}: omega, RMSE rad/s, coverage, log density")
    for where, metrics in rows:
        one = metrics["omega"]
        numbers = f"{one['rmse']:.4f}  {one['coverage']:.2f}  {one['log_density']:.1f}"
        print(f"  {where:40} {numbers}", flush=True)


def examples(first: GpWeights) -> None:
    """Both examples."""
    laps, minute = mpc("harbour", 3, first), pursuit("paddock", 3000)
    later = mpc("harbour", 6, first)
    next_laps = Drive("MPC laps", "harbour", later.samples.select(slice(len(laps.samples), None)))
    example(
        "three MPC laps of harbour",
        laps,
        [
            ("the next three laps", lambda: next_laps),
            ("MPC, paddock", lambda: mpc("paddock", 3, first)),
            ("MPC, random:3", lambda: mpc("random:3", 3, first)),
            ("pure pursuit, harbour", lambda: pursuit("harbour", 3000)),
        ],
    )
    example(
        "60 s of pure pursuit on paddock",
        minute,
        [
            ("another seed", lambda: pursuit("paddock", 3000, 1)),
            ("pure pursuit, harbour", lambda: pursuit("harbour", 3000)),
            ("MPC, paddock", lambda: mpc("paddock", 3, first)),
            ("MPC, harbour", lambda: laps),
        ],
    )


class Learned(NamedTuple):
    """Weights of a drive, and their metrics held out by time."""

    drive: Drive
    weights: GpWeights
    timed: Metrics

    @classmethod
    def of(cls, drive: Drive) -> "Learned":
        """Trained on it."""
        weights = train(drive.samples, PREDICTION, SETTINGS)
        print(".", end="", flush=True)
        return cls(drive, weights, by_time(weights, drive.samples))


def compared(sets: Sequence[Learned], on: Sequence[Learned]) -> None:
    """Each set of weights on the drive of each of ``on`` on another track, all outputs."""
    rows = []
    for drive, weights, timed in sets:
        elsewhere = [measured(weights, one.drive) for one in on if one.drive.track != drive.track]
        for name in OUTPUTS:
            told = weights.metrics[name]
            rows += [
                (
                    told["log_density"] - found[name]["log_density"],
                    timed[name]["log_density"] - found[name]["log_density"],
                    told["coverage"],
                    found[name]["coverage"],
                    np.log(told["rmse"] / found[name]["rmse"]),
                )
                for found in elsewhere
            ]
    mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0)
    print(
        f"{sets[0].drive.driver}, on {on[0].drive.driver}: log density by stretch "
        f"{mean[0]:.1f} +- {spread[0]:.1f}, by time {mean[1]:.1f} +- {spread[1]:.1f}; "
        f"coverage {mean[2]:.2f}, {mean[3]:.2f}; "
        f"RMSE {np.exp(mean[4]):.1f}, a factor of {np.exp(spread[4]):.1f}",
        flush=True,
    )


def main() -> None:
    """The examples, then all drives."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the examples alone")
    options = parser.parse_args()
    first = learned(CAR)
    examples(first)
    if options.quick:
        return
    raced = [Learned.of(mpc(track, laps, first)) for track in TRACKS for laps in LAPS]
    pursued = [Learned.of(pursuit(track, count)) for track in TRACKS for count in SAMPLES]
    print()
    for sets, on in ((raced, raced), (pursued, pursued), (raced, pursued), (pursued, raced)):
        compared(sets, on)


if __name__ == "__main__":
    main()
