"""Laps on tracks with hairpins: first weights, updated weights, the perfect model.

    python -m benchmarks.many_tracks                              the pairs that were difficult
    python -m benchmarks.many_tracks --pair random:7 random:3 --seed 1

Step and simulated car in one process, in lockstep, default settings, two laps each. Where the exact
Hessian is indefinite, a plan may go on into a local minimum that stops short of a bend, with
perfect weights, too; second starts are for that (docs/decisions/2026-11-22-second-start.md).
"""

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console

from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.vehicles import DEFAULT_CAR, get_car
from learning.dataset import concatenate
from operation.closed_loop import Driven, drive_compiled
from operation.preparation import prepare, trained_weights, training_settings
from operation.settings import PreparationSettings
from operation.terminal.progress import Stages, stages_on

__all__ = ["drives"]

PAIRS: Final = (
    ("random:11", "random:3"), ("random:15", "random:3"), ("random:11", "random:5"),
    ("random:15", "random:5"), ("random:7", "random:3"), ("random:21", "random:3"),
    ("random:30", "random:11"), ("harbour", "paddock"),
)  # fmt: skip
"""Race track, training track."""
CAR: Final = get_car(DEFAULT_CAR)


def drives(race: str, training: str, seed: int, stages: Stages) -> dict[str, Driven]:
    """With weights of the training track, with those updated by these laps, without any error."""
    settings = PreparationSettings(train_track=training, seed=seed)
    prepared = prepare(settings, (race,), stages, ("e_kinematic", "dynamic"))
    assert prepared.training is not None
    on, weights = prepared.first, read_weights(prepared.weights)
    nominal, perfect = prepared.artefacts

    def drive(artefact: Path, weights: GpWeights | None = None) -> Driven:
        return drive_compiled(artefact, on.track, on.line, weights, car=CAR)

    first = drive(nominal, weights)
    both = concatenate([prepared.training.samples, first.samples()])
    updated = trained_weights(both, PREDICTION, training_settings(settings), weights)
    return {
        "first": first,
        "updated": drive(nominal, read_weights(updated)),
        "perfect": drive(perfect),
    }


def main() -> None:
    """Drives and prints a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pair", nargs=2, action="append", metavar=("TRACK", "TRAINING"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for race, training in arguments.pair or PAIRS:
        print(f"{race}, trained on {training}, seed {arguments.seed}")
        with stages_on(Console(quiet=True)) as stages:
            driven = drives(race, training, arguments.seed, stages)
        for name, one in driven.items():
            p50, p99 = np.percentile(one.step_us, [50, 99])
            times = f"step p50 {p50:.0f} us, p99 {p99:.0f} us, second starts {one.second_starts}"
            print(f"  {name:8} {one}; {times}", flush=True)


if __name__ == "__main__":
    main()
