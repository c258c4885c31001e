"""Whether what first weights say about their errors holds on the first laps driven with them.

    python -m benchmarks.coverage                                       40 random tracks, two seeds
    python -m benchmarks.coverage --car f1tenth --track random10:1..40 --track workshop

The training drive is pure pursuit on the car's training track; the laps are the controller's, and
faster. Each run is judged with the deviations as ``train`` widens them, without that, and with
other factors; the laps are the same for all (they are driven with the widened ones).

Then the calibration curve: with which share of the samples one step's error is within the band of a
probability, for first weights on first laps and for updated weights on the laps after them. Caution
looks at one side of the track at a time: one-sided is the share of the errors that are no larger
than the normal quantile of the probability, to the side where that is less often so.
"""

import argparse
from collections.abc import Sequence
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS, GpWeights, read_weights
from bayesrace.vehicles import DEFAULT_CAR, CarParameters, get_car
from learning.dataset import Dataset
from learning.scores import NORMAL_95
from learning.settings import TrainingSettings
from learning.validation import validate
from operation.closed_loop import drive_compiled
from operation.preparation import Prepared, prepare, updated_weights
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on
from studies.campaign.plan import spread

FACTORS: Final = (1.0, 1.2, 1.3, 1.4, 1.45)
WANTED: Final = 0.90
"""Share of the errors within the band that is asked for."""
PROBABILITIES: Final = (0.9, 0.95, 0.99)


class Errors(NamedTuple):
    """Of one step on the laps of a run, (n, 3) each, SI units."""

    error: Floats
    sigma: Floats

    def coverage(self, factor: float = 1.0) -> Floats:
        """Share of the errors within the 95 % interval, (3,)."""
        return self.two_sided(factor * NORMAL_95)

    def two_sided(self, quantile: float) -> Floats:
        """Share within so many standard deviations, (3,)."""
        return np.asarray((np.abs(self.error) <= quantile * self.sigma).mean(axis=0))

    def one_sided(self, quantile: float) -> Floats:
        """Share of the errors below the upper bound or above the lower one, the smaller, (3,)."""
        within = [(side * self.error <= quantile * self.sigma).mean(axis=0) for side in (1, -1)]
        return np.asarray(np.minimum(*within))


def laps(prepared: Prepared, car: CarParameters, weights: GpWeights) -> Dataset:
    """Samples of two laps from a standing start."""
    on = prepared.first
    return drive_compiled(prepared.artefacts[0], on.track, on.line, weights, car=car).samples()


def errors(weights: GpWeights, on: Dataset, settings: PreparationSettings) -> Errors:
    """Of these weights on what was driven with them."""
    found = validate(weights, on, settings.discretisation)
    return Errors(found.error, found.sigma)


def run(car: CarParameters, track: str, seed: int) -> tuple[Errors, Errors]:
    """Of first weights on two first laps, and of updated ones on the next two."""
    settings = PreparationSettings(car=car, seed=seed)
    with stages_on(Console(quiet=True)) as stages:
        prepared = prepare(settings, (track,), stages)
    assert prepared.training is not None
    first = read_weights(prepared.weights)
    driven = laps(prepared, car, first)
    samples = [prepared.training.samples, driven]
    updated = read_weights(updated_weights(samples, settings, first))
    next_laps = laps(prepared, car, updated)
    return errors(first, driven, settings), errors(updated, next_laps, settings)


def print_factors(runs: Sequence[Errors]) -> None:
    """A row for each factor on the deviations of first weights."""
    as_trained = TrainingSettings().widen
    print(f"first weights; shares of the runs whose 95 % band holds {WANTED:.0%} of the errors")
    for factor in FACTORS:
        share = factor / as_trained
        coverage = np.array([one.coverage(share) for one in runs])
        held = coverage >= WANTED
        band = np.median([share * NORMAL_95 * np.median(one.sigma, axis=0) for one in runs], axis=0)
        print(
            f"  deviations x {factor:.2f}: {_numbers(held.mean(axis=0))}, all three "
            f"{held.all(axis=1).mean():.2f}; least coverage {_numbers(coverage.min(axis=0))}; "
            f"median half band {band[0]:.2g} m/s, {band[1]:.2g} m/s, {band[2]:.2g} rad/s"
        )


def print_curve(name: str, runs: Sequence[Errors]) -> None:
    """A row for each probability: means of the runs, and the run that ten per cent are below."""
    print(f"{name}; shares of the errors within the band: mean, and 10 % of the runs have less")
    for probability in PROBABILITIES:
        normal = NormalDist()
        two = [one.two_sided(normal.inv_cdf((1 + probability) / 2)) for one in runs]
        single = [one.one_sided(normal.inv_cdf(probability)) for one in runs]
        both = "; ".join(
            f"{side} {_numbers(np.mean(shares, axis=0), 3)}, "
            f"{_numbers(np.quantile(shares, 0.1, axis=0), 3)}"
            for side, shares in (("two-sided", two), ("one-sided", single))
        )
        print(f"  {probability:.2f}: {both}")


def _numbers(values: Floats, digits: int = 2) -> str:
    return " ".join(f"{one:.{digits}f}" for one in values)


def main() -> None:
    """Prints a row for each factor, and one for each probability and kind of weights."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--car", default=DEFAULT_CAR)
    parser.add_argument("--track", action="append", help="repeatable; random:1..40 without")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    tracks = [one for given in arguments.track or ["random:1..40"] for one in spread(given)]
    car, seeds = get_car(arguments.car), range(arguments.seeds)
    first, updated = zip(
        *(run(car, track, seed) for seed in seeds for track in tracks), strict=True
    )
    print(f"{len(first)} runs of {car.name}; {', '.join(OUTPUTS)}")
    print_factors(first)
    print_curve("first weights", first)
    print_curve("updated weights", updated)


if __name__ == "__main__":
    main()
