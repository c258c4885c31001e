"""What the prediction's pose rows cost: integrated with the nominal model, or from the velocities.

    python -m benchmarks.pose_discretisation [--track T --train-track T]

For every discretisation of the e-kinematic model the chain of the race, in one process: training
drive, GP, BayesRace, update, BayesRace-updated; BestCase for comparison. One line each, with the
error that the corrected model makes of the heading in one step on the BestCase drive.
docs/decisions/2026-11-21-pose-from-corrected-velocities.md holds the conclusion.
"""

import argparse

import numpy as np
from rich.console import Console

from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.raceline import RaceLine
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK, Track
from bayesrace.vehicles import DEFAULT_CAR, get_car
from bayesrace.vehicles.models import e_kinematic
from codegen.build import build
from codegen.settings import BuildSettings
from learning.dataset import Dataset, concatenate
from learning.training import train
from operation.closed_loop import Driven, drive_compiled
from operation.preparation import prepare, training_settings
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on

CAR = get_car(DEFAULT_CAR)
TRAINING = training_settings(PreparationSettings())


def heading_error_rad(samples: Dataset, prediction: Discretisation, weights: GpWeights) -> str:
    """Of the corrected model over one step: root mean square and largest."""
    f = corrected_function(e_kinematic(CAR), prediction, weights)
    predicted = np.asarray(f.map(len(samples))(samples.x.T, samples.u.T)).T
    error = samples.x_next[:, 2] - predicted[:, 2]
    return f"{np.sqrt(np.mean(error**2)):.1e} / {np.abs(error).max():.1e}"


def chain(
    prediction: Discretisation, training: Dataset, course: tuple[Track, RaceLine], best: Driven
) -> None:
    """Prints what one discretisation leads to."""
    artefact, _ = build(BuildSettings(car=CAR.name, discretisation=prediction))
    weights = train(training, prediction, TRAINING)
    first = drive_compiled(artefact, *course, weights, car=CAR)
    both = concatenate([training, first.samples()])
    updated = train(both, prediction, TRAINING, initial=weights)
    second = drive_compiled(artefact, *course, updated, car=CAR)
    print(f"{prediction.scheme}, {prediction.pose}")
    print(f"  bayesrace          {first}")
    print(f"  bayesrace-updated  {second}")
    heading = heading_error_rad(best.samples(), prediction, updated)
    print(f"  heading error of one step, rms / max: {heading} rad", flush=True)


def main() -> None:
    """Measures; about a minute."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--train-track", default=DEFAULT_TRAINING_TRACK)
    arguments = parser.parse_args()
    settings = PreparationSettings(train_track=arguments.train_track)
    with stages_on(Console()) as stages:
        prepared = prepare(settings, (arguments.track,), stages, ("dynamic",))
    assert prepared.training is not None
    track, line = course = prepared.first.track, prepared.first.line
    best = drive_compiled(prepared.artefacts[0], *course, car=CAR)
    print(f"{track.name}: racing line's own time {line.lap_time_s:.3f} s (flying)")
    print(f"bestcase             {best}", flush=True)
    for scheme in ("euler", "rk4"):
        for pose in ("integrated", "interpolated"):
            prediction = PREDICTION.model_copy(update={"scheme": scheme, "pose": pose})
            chain(prediction, prepared.training.samples, course, best)


if __name__ == "__main__":
    main()
