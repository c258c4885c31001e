"""Laps on tracks with hairpins: first weights, updated weights, the perfect model.

    python -m benchmarks.many_tracks                              the pairs that were difficult
    python -m benchmarks.many_tracks --pair random:7 random:3 --seed 1

Step and simulated car in one process, in lockstep, default settings, two laps each. Where the exact
Hessian is indefinite, a plan may go on into a local minimum that stops short of a bend, with
perfect weights, too; second starts are for that (docs/decisions/2026-11-22-second-start.md).
"""

import argparse
from typing import Final

import numpy as np

from bayesrace.integrators import PREDICTION
from bayesrace.raceline.cached import racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles import DEFAULT_CAR, get_car
from benchmarks.closed_loop import Drive, drive
from codegen.build import build
from codegen.settings import BuildSettings
from experiments.preparation import trained_weights, training_samples
from learning.dataset import concatenate
from learning.training import TrainingSettings

__all__ = ["drives"]

PAIRS: Final = (
    ("random:11", "random:3"), ("random:15", "random:3"), ("random:11", "random:5"),
    ("random:15", "random:5"), ("random:7", "random:3"), ("random:21", "random:3"),
    ("random:30", "random:11"), ("harbour", "paddock"),
)  # fmt: skip
"""Race track, training track."""
CAR: Final = get_car(DEFAULT_CAR)


def drives(race: str, training: str, seed: int) -> dict[str, Drive]:
    """With weights of the training track, with those updated by these laps, without any error."""
    track = load_track(race)
    line = racing_line(track, CAR)
    samples = training_samples(load_track(training), CAR, CAR.tuning.pursuit.drive_s, seed)
    settings = TrainingSettings(seed=seed)
    weights = trained_weights(samples, PREDICTION, settings)
    nominal, perfect = build(BuildSettings())[0], build(BuildSettings.best_case())[0]
    first = drive(nominal, CAR, track, line, weights)
    both = concatenate([samples, first.samples(CAR, PREDICTION.step_s)])
    updated = trained_weights(both, PREDICTION, settings, weights)
    return {
        "first": first,
        "updated": drive(nominal, CAR, track, line, updated),
        "perfect": drive(perfect, CAR, track, line),
    }


def main() -> None:
    """Drives and prints a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pair", nargs=2, action="append", metavar=("TRACK", "TRAINING"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for race, training in arguments.pair or PAIRS:
        print(f"{race}, trained on {training}, seed {arguments.seed}")
        for name, one in drives(race, training, arguments.seed).items():
            p50, p99 = np.percentile(one.step_us, [50, 99])
            times = f"step p50 {p50:.0f} us, p99 {p99:.0f} us, second starts {one.second_starts}"
            print(f"  {name:8} {one}; {times}", flush=True)


if __name__ == "__main__":
    main()
