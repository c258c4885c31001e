"""Whether the 95 % band of first weights holds on the first laps that are driven with them.

    python -m benchmarks.coverage                                       40 random tracks, two seeds
    python -m benchmarks.coverage --car f1tenth --track airfield --track workshop

The training drive is pure pursuit on the car's training track; the laps are the controller's, and
faster. Each run is judged with the deviations as ``train`` widens them, without that, and with
other factors; the laps are the same for all (they are driven with the widened ones).
"""

import argparse
from typing import Final

import numpy as np
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS, read_weights
from bayesrace.vehicles import DEFAULT_CAR, CarParameters, get_car
from learning.scores import NORMAL_95
from learning.settings import TrainingSettings
from learning.validation import validate
from operation.closed_loop import drive_compiled
from operation.preparation import prepare
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on

__all__ = ["normalised_errors"]

FACTORS: Final = (1.0, 1.2, 1.3, 1.4, 1.45)
WANTED: Final = 0.90
"""Share of the errors within the band that is asked for."""


def normalised_errors(car: CarParameters, track: str, seed: int) -> tuple[Floats, Floats]:
    """Of two first laps: errors (n, 3) as shares of the band as trained, and the band (n, 3)."""
    settings = PreparationSettings(car=car, seed=seed)
    with stages_on(Console(quiet=True)) as stages:
        prepared = prepare(settings, (track,), stages)
    weights, on = read_weights(prepared.weights), prepared.first
    driven = drive_compiled(prepared.artefacts[0], on.track, on.line, weights, car=car)
    found = validate(weights, driven.samples(), settings.discretisation)
    return np.abs(found.error) / (NORMAL_95 * found.sigma), found.band


def main() -> None:
    """Prints a row for each factor."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--car", default=DEFAULT_CAR)
    parser.add_argument("--track", action="append", help="repeatable; random:1..40 without")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    tracks = arguments.track or [f"random:{i}" for i in range(1, 41)]
    car, seeds = get_car(arguments.car), range(arguments.seeds)
    runs = [normalised_errors(car, track, seed) for seed in seeds for track in tracks]
    as_trained = TrainingSettings().widen
    names = ", ".join(OUTPUTS)
    print(f"{len(runs)} runs; shares of the runs whose band holds {WANTED:.0%} of the errors")
    for factor in FACTORS:
        share = factor / as_trained
        held = np.array([(errors <= share).mean(axis=0) >= WANTED for errors, _ in runs])
        band = np.median([share * np.median(band, axis=0) for _, band in runs], axis=0)
        each = " ".join(f"{one:.2f}" for one in held.mean(axis=0))
        print(
            f"  deviations x {factor:.2f}: {names} {each}, all three {held.all(axis=1).mean():.2f};"
            f" median half band {band[0]:.2g} m/s, {band[1]:.2g} m/s, {band[2]:.2g} rad/s"
        )


if __name__ == "__main__":
    main()
