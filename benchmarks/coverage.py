"""Whether what weights say about their errors holds on the laps that are driven with them.

    python -m benchmarks.coverage                                       40 random tracks, two seeds
    python -m benchmarks.coverage --car f1tenth --tracks random10:1..40 workshop

First weights are learned from pure pursuit on the car's training track, and judged on the first two
laps with them; updated weights have learned from these laps, too, and are judged on the next two.
Prints the held-out metrics in the weights, those that the laps show, and the share of one step's
errors within the band of a probability; one-sided: no larger than the normal quantile, to the side
where that is less often so.
"""

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from bayesrace.gp.weights import OUTPUTS, GpWeights, read_weights
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.validation import Validation, validate
from bayesrace.operation.closed_loop import drive_compiled
from bayesrace.operation.preparation import updated_weights
from bayesrace.operation.settings import PreparationSettings
from bayesrace.studies.settings import spread
from bayesrace.vehicles import DEFAULT_CAR, get_car
from benchmarks.harness import Row, arguments, prepared, report

_PROBABILITIES, _METRICS = (0.9, 0.95, 0.99), ("coverage", "log_density", "rmse")

Judged = tuple[GpWeights, Validation]
"""Weights, and what a drive with them shows."""


def run(settings: PreparationSettings, track: str) -> tuple[Judged, Judged]:
    """First weights on two first laps, and updated ones on the next two."""
    made, car, step = prepared(track, **dict(settings)), settings.car, settings.discretisation
    assert made.training is not None

    def driven(weights: GpWeights) -> Dataset:
        on = made.first
        return drive_compiled(made.artefacts[0], on.track, on.line, weights, car=car).samples()

    first = read_weights(made.weights)
    laps = driven(first)
    updated = read_weights(updated_weights([made.training.samples, laps], settings, first))
    last = validate(updated, driven(updated), step)
    return (first, validate(first, laps, step)), (updated, last)


def rows_of(name: str, drives: Sequence[Judged]) -> list[Row]:
    """A row for each statistic, with a column for each output."""
    rows = []

    def add(what: str, values: object) -> None:
        numbers = np.asarray(values, float).tolist()
        rows.append({"weights": name, "": what} | dict(zip(OUTPUTS, numbers, strict=True)))

    for metric in _METRICS:
        for number, where in enumerate(("held out", "on the laps")):
            values = [[one[number].metrics[o][metric] for o in OUTPUTS] for one in drives]
            add(f"{metric} {where}", np.mean(values, axis=0))
    held = [[on.metrics[output]["coverage"] >= 0.9 for output in OUTPUTS] for _, on in drives]
    add("drives whose 95 % band holds 90 %", np.mean(held, axis=0))
    errors = [on.error / on.sigma for _, on in drives]
    for p in _PROBABILITIES:
        two, one = NormalDist().inv_cdf((1 + p) / 2), NormalDist().inv_cdf(p)
        add(f"two-sided {p}", np.mean([(np.abs(e) <= two).mean(0) for e in errors], axis=0))
        sides = [np.minimum((e <= one).mean(0), (-e <= one).mean(0)) for e in errors]
        add(f"one-sided {p}", np.mean(sides, axis=0))
        add(f"one-sided {p}, a tenth of the drives have less", np.quantile(sides, 0.1, axis=0))
    return rows


def main() -> None:
    """Drives on all tracks with all seeds, and prints the statistics."""
    given = arguments(__doc__, car=DEFAULT_CAR, tracks=("random:1..40",), seeds=2)
    car, tracks = get_car(given.car), [one for text in given.tracks for one in spread(text)]
    settings = [PreparationSettings(car=car, seed=seed) for seed in range(given.seeds)]
    first, updated = zip(*(run(one, track) for one in settings for track in tracks), strict=True)
    rows = rows_of("first", first) + rows_of("updated", updated)
    report(given, f"{len(first)} drives of {car.name}", rows)


if __name__ == "__main__":
    main()
