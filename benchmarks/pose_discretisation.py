"""What the prediction's pose rows cost: integrated with the nominal model, or from the velocities.

    python -m benchmarks.pose_discretisation [--track T --train-track T]

For every discretisation of the e-kinematic model the chain of the race, in one process: training
drive, GP, BayesRace, update, BayesRace-updated; BestCase for comparison. One line each, with the
error that the corrected model makes of the heading in one step on the BestCase drive.
docs/decisions/2026-11-21-pose-from-corrected-velocities.md holds the conclusion.
"""

import argparse

import numpy as np

from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.raceline import RaceLine, compute_raceline
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK, Track, load_track
from bayesrace.vehicles import DEFAULT_CAR, get_car
from bayesrace.vehicles.models import e_kinematic
from benchmarks.closed_loop import Drive, drive, pursue
from codegen.build import build
from codegen.settings import BuildSettings
from experiments.settings import RaceSettings
from learning.dataset import Dataset, concatenate
from learning.training import TrainingSettings, train

CAR = get_car(DEFAULT_CAR)
TRAINING = TrainingSettings(capacity=RaceSettings().points)


def heading_error_rad(samples: Dataset, prediction: Discretisation, weights: GpWeights) -> str:
    """Of the corrected model over one step: root mean square and largest."""
    f = corrected_function(e_kinematic(CAR), prediction, weights)
    predicted = np.asarray(f.map(len(samples))(samples.x.T, samples.u.T)).T
    error = samples.x_next[:, 2] - predicted[:, 2]
    return f"{np.sqrt(np.mean(error**2)):.1e} / {np.abs(error).max():.1e}"


def chain(
    prediction: Discretisation, training: Dataset, course: tuple[Track, RaceLine], best: Drive
) -> None:
    """Prints what one discretisation leads to."""
    artefact, _ = build(BuildSettings(car=CAR.name, discretisation=prediction))
    weights = train(training, prediction, TRAINING)
    first = drive(artefact, CAR, *course, weights)
    both = concatenate([training, first.samples(CAR, prediction.step_s)])
    updated = train(both, prediction, TRAINING, initial=weights)
    second = drive(artefact, CAR, *course, updated)
    print(f"{prediction.scheme}, {prediction.pose}")
    print(f"  bayesrace          {first}")
    print(f"  bayesrace-updated  {second}")
    heading = heading_error_rad(best.samples(CAR, prediction.step_s), prediction, updated)
    print(f"  heading error of one step, rms / max: {heading} rad", flush=True)


def main() -> None:
    """Measures; about a minute."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--train-track", default=DEFAULT_TRAINING_TRACK)
    arguments = parser.parse_args()
    training, track = load_track(arguments.train_track), load_track(arguments.track)
    course = track, compute_raceline(track, CAR)
    samples = pursue(CAR, training, compute_raceline(training, CAR), PREDICTION.step_s)
    perfect, _ = build(BuildSettings.best_case(CAR.name))
    best = drive(perfect, CAR, *course)
    print(f"{track.name}: racing line's own time {course[1].lap_time_s:.3f} s (flying)")
    print(f"bestcase             {best}", flush=True)
    for scheme in ("euler", "rk4"):
        for pose in ("integrated", "interpolated"):
            prediction = PREDICTION.model_copy(update={"scheme": scheme, "pose": pose})
            chain(prediction, samples, course, best)


if __name__ == "__main__":
    main()
