"""A car that has changed since it was learned: what was learned before is brought up to date."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.gp.weights import write_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.change import brought_up_to_date
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.symmetry import symmetric
from bayesrace.learning.training import perform, train
from bayesrace.learning.validation import residual
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.operation.preparation import Prepared, prepare, training_settings, updated_weights
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.simulator import PLANT, Simulator
from bayesrace.vehicles import default_car
from bayesrace.vehicles.models import Model, dynamic
from tests.changed_cars import CHANGES, TRIM_RAD, changed, trimmed
from tests.racing import prepared, racing

CHANGED = [how for how in CHANGES if how != "as in the file"]


def trained() -> Dataset:
    training = prepared().training
    assert training is not None
    return training.samples


def first_laps(how: str) -> Dataset:
    """Of a car that has changed, by weights that do not know it."""
    race = racing()
    return (
        ClosedLoop(race.car, race.track, race.line, race.controller(), changed(race.car, how))
        .drive()
        .samples()
    )


def true_residual(samples: Dataset, model: Model) -> Floats:
    """Of this car, where the samples are; by the simulator's own integration."""
    step = PLANT.discretise(model)
    after = np.asarray(step(samples.x.T, samples.u.T), dtype=np.float64).T
    whole = Dataset(samples.car, samples.step_s, samples.x, samples.u, after)
    return residual(whole, PREDICTION)


def test_samples_of_a_car_that_is_the_same_stay_as_they_are() -> None:
    race, before = racing(), trained()
    every = concatenate([before, race.driven.samples()])
    same, moved = brought_up_to_date(every, race.weights, PREDICTION)
    assert same is every
    assert moved == 0


@pytest.mark.parametrize("how", CHANGED)
def test_samples_from_before_become_those_of_the_car_as_it_is(how: str) -> None:
    """Against the changed car's equations at the same states and inputs: moved samples are nearer
    to them, and as near as they claim."""
    race, before, after = racing(), trained(), first_laps(how)
    driven = concatenate([before, after])
    every, moved = brought_up_to_date(driven, race.weights, PREDICTION)
    assert abs(moved - len(before)) <= 10
    rest = slice(moved, None)
    assert every.select(rest).x_next.tobytes() == driven.select(rest).x_next.tobytes()
    assert not every.select(rest).deviation.any()
    turned = TRIM_RAD if how == "trim 1 degree" else 0.0
    model = trimmed(dynamic(CHANGES[how](race.car)), turned)
    past, now = driven.select(slice(moved)), every.select(slice(moved))
    truth, claimed = true_residual(past, model), now.deviation[:, :3]
    wrong = np.abs(residual(past, PREDICTION) - truth)
    left = np.abs(residual(now, PREDICTION) - truth)
    worst = int(np.argmax((wrong / claimed).mean(axis=0)))
    assert np.median(left[:, worst]) < 0.1 * np.median(wrong[:, worst])
    rounding = np.array([1e-4, 1e-4, 1e-3])  # of the plant's integration, which is another one
    assert (np.mean(left < 3 * claimed + rounding, axis=0) > 0.85).all()


def test_a_change_in_the_middle_of_a_drive_is_found_where_it_is() -> None:
    race = racing()
    same, other = race.driven.samples(), first_laps("mass + 20 %")
    moved = brought_up_to_date(concatenate([same, other]), race.weights, PREDICTION)[1]
    assert abs(moved - len(same)) <= 10


def test_a_car_that_has_changed_and_is_known_again_stays_as_it_is() -> None:
    """What has been moved once does not contradict the weights that were learned of it."""
    race, other = racing(), first_laps("grip 0.9")
    every, moved = brought_up_to_date(concatenate([trained(), other]), race.weights, PREDICTION)
    assert moved
    settings = training_settings(PreparationSettings())
    learned = train(every, PREDICTION, settings, race.weights)
    assert brought_up_to_date(concatenate([every, other]), learned, PREDICTION)[1] == 0


@pytest.mark.check
def test_a_car_on_a_track_that_bends_to_one_side_has_none(peanut_track: Path) -> None:
    settings = PreparationSettings(train_track=str(peanut_track))
    with stages_on(Console(quiet=True)) as stages:
        prepared = prepare(settings, (str(peanut_track),), stages, ("e_kinematic",))
    assert symmetric(concatenate(prepared.samples), PREDICTION)


def test_a_car_with_a_side_is_told_from_one_without() -> None:
    """Training leaves mirror images out; a car whose file allows none is not asked."""
    side = first_laps("trim 1 degree")
    assert not symmetric(side, PREDICTION)
    for samples in (trained(), racing().driven.samples(), first_laps("grip 0.8")):
        assert symmetric(samples, PREDICTION)
    one_sided = racing().car.model_copy(update={"mirrored_samples": False})
    assert not symmetric(replace(trained(), car=one_sided), PREDICTION)
    small = TrainingSettings(kernels=("rbf",), capacity=50, hyper_points=100, restarts=0)
    counts = [train(one, PREDICTION, small).metrics["training vx"]["samples"] for one in
              (side, trained())]  # fmt: skip
    assert counts == [len(side), 2 * len(trained())]


def driven(
    files: Prepared, artefact: Path, vehicle: Simulator, weights: Path | None = None
) -> Driven:
    car, on = default_car(), (files.first.track, files.first.line)
    controller = compiled_controller(
        artefact, vehicle.car if weights is None else car, *on, weights
    )
    return ClosedLoop(car, *on, controller, vehicle).drive()


def test_a_learning_job_moves_what_it_has_kept_once(tmp_path: Path) -> None:
    """By the weights that know what was kept; also where no controller has accepted them."""
    race, other = racing(), first_laps("grip 0.9")
    small = TrainingSettings(kernels=("rbf",), capacity=150, hyper_points=150, restarts=0)
    write_weights(tmp_path / "before.bin", race.weights)
    samples, files = [trained(), other], [tmp_path / "before.bin", tmp_path / "after.bin"]
    moved = []
    for known in files:
        done = perform(PREDICTION, samples, files[0], small, 1200, known)
        assert done.weights is not None
        assert done.kept is not None
        moved.append(done.moved)
        write_weights(files[1], done.weights)
        samples = [done.kept, other]
    assert abs(moved[0] - len(trained())) <= 10
    assert moved[1] == 0


def test_samples_stay_as_they_are_where_nothing_can_be_learned(tmp_path: Path) -> None:
    write_weights(tmp_path / "known.bin", racing().weights)
    few = first_laps("grip 0.9").select(slice(5))
    done = perform(PREDICTION, [few], None, TrainingSettings(), 1200, tmp_path / "known.bin")
    assert "samples" in done.error
    assert done.kept is not None
    assert done.kept.digest() == few.digest()


@pytest.mark.check
@pytest.mark.parametrize("how", CHANGED)
def test_a_changed_car_drives_as_if_it_were_known_after_one_update(how: str) -> None:
    """Flying laps within 1 % of BestCase's, which knows the car but for its trim; of the least
    grip, for which the line is too fast, within 3 %."""
    settings = PreparationSettings()
    for track in ("random:41", "random:47"):
        files = prepared(track)
        car = default_car()

        known = CHANGES[how](car)
        perfect = driven(files, build(BuildSettings.best_case(known))[0], built_in_car(known))
        first = driven(files, files.artefacts[0], changed(car, how), files.weights)
        samples = [*files.samples, first.samples()]
        updated, _ = updated_weights(samples, settings, files.weights)
        again = driven(files, files.artefacts[0], changed(car, how), updated)
        share = 1.03 if how == "grip 0.8" else 1.01
        assert again.laps_s[1] < share * perfect.laps_s[1]
        assert again.off_track_m.max() < max(perfect.off_track_m.max(), 0) + 0.005
