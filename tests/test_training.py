"""Training: kernels by smoothness, chosen samples, cross-validation and calibrated intervals, what
is carried, kept and reported, what is refused; lap by lap, in a process of its own."""

import os
import signal
import threading
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace import __version__
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import (
    KERNELS,
    OUTPUTS,
    Weights,
    decode_weights,
    encode_weights,
    write_weights,
    zero_weights,
)
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.gaussian_process import (
    BOUNDS,
    Covariance,
    Fit,
    PairDistances,
    maximise,
    refine,
    starts,
)
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.subset import MOST_NEW, bounded, stretches
from bayesrace.learning.target import PredictionErrors, Target
from bayesrace.learning.training import (
    MAX_SAMPLES,
    NICE,
    Outcome,
    Trainer,
    Training,
    fit,
    perform,
    train,
)
from bayesrace.learning.validation import (
    discretisation_of,
    identity,
    predictive_sigma,
    recalled,
    residual,
    validate,
)
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.driven import CAR, QUICK, STEP_S, drive
from tests.programs import until
from tests.scikit import scikit_gp


@pytest.fixture(scope="module")
def driven() -> Dataset:
    return drive(dynamic(CAR), 160, seed=1)


@pytest.fixture(scope="module")
def chosen(driven: Dataset) -> Training:
    """Every kernel, a third of the samples."""
    settings = QUICK.model_copy(update={"kernels": KERNELS, "capacity": 50})
    return fit(driven, PREDICTION, settings)


# Optimum ---------------------------------------------------------------------------------------


def test_the_optimum_is_scikit_learns() -> None:
    """Same starts, same bounds: the best log marginal likelihoods agree within 1e-3."""
    data = drive(dynamic(CAR), 70, seed=3)
    folds = np.zeros(len(data), dtype=np.int64)
    for column in residual(data, PREDICTION).T[1:]:
        target = Target.of("vy", data.features, column, folds)
        pairs, found = PairDistances(target.z), []
        guesses = starts(1, seed=0)
        for guess in guesses:
            with pytest.warns():  # that noise and some length scales end at their bounds
                gp = scikit_gp("rbf", guess, target.z, target.y, BOUNDS)
            found.append(gp.log_marginal_likelihood_value_)
        ours = [maximise("rbf", pairs, target.y, guess, 300, 1e-9) for guess in guesses]
        assert max(fit.log_likelihood for fit in ours) == pytest.approx(max(found), abs=1e-3)


@pytest.mark.parametrize("kind", ["rbf", "matern25"])
def test_a_fit_to_a_third_of_the_samples_is_refined_to_the_optimum(
    driven: Dataset, kind: str
) -> None:
    y, folds = residual(driven, PREDICTION)[:, 1], np.zeros(len(driven), dtype=np.int64)
    target = Target.of("vy", driven.features, y, folds)
    pairs, (start,) = PairDistances(target.z), starts(0, seed=0)
    rough = maximise(kind, PairDistances(target.z[::3]), target.y[::3], start, 100)
    found = refine(pairs, target.y, rough, 100)
    whole = maximise(kind, pairs, target.y, start, 300, 1e-9)
    assert found.log_likelihood == pytest.approx(whole.log_likelihood, abs=1e-2)
    assert np.all((BOUNDS[:, 0] <= found.theta) & (found.theta <= BOUNDS[:, 1]))


# Choice of kernel and samples --------------------------------------------------------------------


def test_every_kernel_is_scored_and_the_best_density_is_chosen(chosen: Training) -> None:
    for i, output in enumerate(OUTPUTS):
        own = [score for score in chosen.kernels if score.output == output]
        assert [score.kernel for score in own] == list(KERNELS)
        winner = max(own, key=lambda score: score.log_density)
        assert [score.kernel for score in own if score.chosen] == [winner.kernel]
        assert chosen.weights.kernels[i] == winner.kernel
        rough = next(score for score in own if score.kernel == "matern05")
        assert winner.rmse < rough.rmse  # smooth dynamics


def test_prediction_by_stretches_leaves_the_stretch_out(driven: Dataset) -> None:
    rows = np.arange(len(driven))
    y = residual(driven, PREDICTION)[:, 1]
    target = Target.of("vy", driven.features, y, 4 * rows // len(driven))
    without = target.errors_from(rows[:30], Covariance("matern25", 2.0, np.full(6, 1.5), 0.02))
    # The first stretch, rows 0 to 39, holds all that is known: there is nothing but the prior.
    assert without.error[5] == pytest.approx(target.y[5])
    assert without.sigma[5] == pytest.approx(np.sqrt(2.02))
    assert without.sigma[100] < without.sigma[5]


def test_training_that_is_interrupted_begins_nothing_more(
    driven: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, interruption = [], threading.Event()

    def counted(*arguments: Any, **known: Any) -> Fit:
        begun.append(arguments[0])
        if len(begun) > 12:
            interruption.wait(60)
        return maximise(*arguments, **known)

    def interrupted(share: float, text: str) -> None:
        interruption.set()
        raise KeyboardInterrupt

    monkeypatch.setattr("bayesrace.learning.training.maximise", counted)
    settings = QUICK.model_copy(update={"restarts": 10, "threads": 1})
    with pytest.raises(KeyboardInterrupt):
        fit(driven, PREDICTION, settings, progress=interrupted)
    assert 11 <= len(begun) < 33


# What the weights carry --------------------------------------------------------------------------


def test_weights_carry_what_they_were_made_from_and_how_good_they_are(
    chosen: Training, driven: Dataset
) -> None:
    weights = decode_weights(encode_weights(chosen.weights))
    assert weights.counts == (50, 50, 50)
    assert weights.program == f"bayesrace {__version__}"
    assert weights.created_utc_ns > 1_700_000_000 * 10**9
    assert weights.dataset_digest == driven.digest()
    assert weights.discretisation == identity(driven, PREDICTION)
    for output in OUTPUTS:
        held = weights.metrics[output]
        assert {"rmse", "r2", "coverage", "log_density", "uncorrected_rmse"} == set(held)
        assert 0 < held["rmse"] < held["uncorrected_rmse"]
        assert held["r2"] < 1
        assert weights.metrics[f"training {output}"]["points"] == 50
        assert weights.metrics[f"training {output}"]["samples"] == 2 * len(driven)  # and images


def test_the_metrics_carried_are_those_of_samples_not_learned_from(driven: Dataset) -> None:
    """The error on the samples themselves is far smaller and says little about a drive."""
    weights = train(driven, PREDICTION, QUICK)
    y = residual(driven, PREDICTION)
    own = np.sqrt(np.mean((y - evaluate_mean(weights, driven.features)) ** 2, axis=0))
    for i, output in enumerate(OUTPUTS):
        assert weights.metrics[output]["rmse"] > 2 * own[i]
    assert np.all(predictive_sigma(weights, driven.features) > 0)


def test_first_weights_are_less_sure_and_predict_the_same(driven: Dataset) -> None:
    """What they are driven with is no longer what they were learned from; updates know it."""
    plain, wide = (
        train(driven, PREDICTION, QUICK.model_copy(update={"widen": factor}))
        for factor in (1.0, 1.5)
    )
    z = driven.features + 0.1
    assert predictive_sigma(wide, z) == pytest.approx(1.5 * predictive_sigma(plain, z))
    assert evaluate_mean(wide, z) == pytest.approx(evaluate_mean(plain, z))
    again, same = (
        train(driven, PREDICTION, QUICK.model_copy(update={"widen": factor}), initial=plain)
        for factor in (1.0, 1.5)
    )
    assert again.version == same.version


def test_mirror_images_show_the_other_way_round(driven: Dataset) -> None:
    """Samples of right turns alone predict left turns, where another car's do not."""
    right = driven.select(driven.x[:, 5] < 0)
    left = driven.select(driven.x[:, 5] > 0)
    other = right.car.model_copy(update={"mirrored_samples": False})
    error = {}
    for car in (right.car, other):
        weights = train(replace(right, car=car), PREDICTION, QUICK)
        y = residual(left, PREDICTION)
        mean = evaluate_mean(weights, left.features)
        error[car.mirrored_samples] = np.sqrt(np.mean((y - mean) ** 2, axis=0)) / y.std(axis=0)
        image = evaluate_mean(weights, left.features * (1, -1, -1, -1, 1, -1))
        apart = np.abs(image * (1, -1, -1) - mean).max(axis=0) / y.std(axis=0)
        assert (apart < 0.1).all() == car.mirrored_samples
    assert (error[True] < 0.3 * error[False]).all()


def test_weights_are_reproducible_and_named_by_content_not_by_time_and_program(
    driven: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = train(driven, PREDICTION, QUICK)
    monkeypatch.setattr("bayesrace.learning.training.__version__", "9.9")
    again = train(driven, PREDICTION, QUICK)
    assert again.program == "bayesrace 9.9"
    assert again.version == first.version
    for a, b in zip(first.outputs, again.outputs, strict=True):
        assert np.array_equal(a.alpha, b.alpha)
    assert train(driven.select(slice(100)), PREDICTION, QUICK).version != first.version


# Refusals ----------------------------------------------------------------------------------------


def test_samples_that_nothing_can_be_learned_from_are_refused(driven: Dataset) -> None:
    nominal = drive(e_kinematic(CAR), 60, seed=0, substeps=PREDICTION.substeps)
    for data, words in (
        (replace(driven, u=driven.u * [0, 1] + [0.4, 0]), r"d is 0\.4 in every sample"),
        (replace(driven, u=driven.u * [1, 0] + [0, 0.4]), r"delta_rate is 0\.4 in every sample"),
        (nominal, "nothing to learn"),
        (driven.select(slice(19)), "19 samples, at least 20"),
        (driven.select(np.zeros(MAX_SAMPLES + 1, dtype=np.int64)), "fewer logs"),
    ):
        with pytest.raises(InputError, match=words):
            train(data, PREDICTION, QUICK)


@pytest.mark.parametrize(
    "discretisation",
    [
        PREDICTION,
        Discretisation(scheme="euler", step_s=0.005, substeps=3),
        Discretisation(scheme="heun", step_s=1 / 3, substeps=1, pose="interpolated"),
    ],
)
def test_an_identity_names_its_discretisation(discretisation: Discretisation) -> None:
    name = discretisation.identity(e_kinematic(CAR).name, CAR)
    again = discretisation_of(name, CAR)
    assert again.identity(e_kinematic(CAR).name, CAR) == name
    assert again.step_s == pytest.approx(discretisation.step_s, rel=1e-8)


@pytest.mark.parametrize("name", ["", "a/b/c/d", "e_kinematic/rk4x1-interpolated/0.02s/orca-00"])
def test_other_names_are_no_discretisation(name: str) -> None:
    with pytest.raises(InputError):
        discretisation_of(name, CAR)
    perfect = PREDICTION.identity("dynamic", CAR)
    with pytest.raises(InputError, match="e_kinematic"):
        discretisation_of(perfect, CAR)


def circling(laps: float, count: int, radius_m: float, shift_m: float = 0.0) -> Dataset:
    """Laps of a circle anticlockwise, ``shift_m`` to the right of it, evenly in time."""
    angle = np.linspace(0.0, 2 * np.pi * laps, count, endpoint=False)
    x = np.zeros((count, 7))
    x[:, 0], x[:, 1] = (radius_m + shift_m) * np.cos(angle), (radius_m + shift_m) * np.sin(angle)
    x[:, 2] = angle + np.pi / 2
    return Dataset(CAR, STEP_S, x, np.zeros((count, 2)), x)


# Stretches -----------------------------------------------------------------------------------


def test_all_passages_of_a_place_are_left_out_together() -> None:
    """Three laps, each on another line: a stretch is a piece of the circle, of all of them."""
    laps = [circling(1, 200, 2.0, shift_m) for shift_m in (0.0, 0.1, -0.1)]
    number = stretches(concatenate(laps), 10)
    assert set(number) == set(range(10))
    assert np.bincount(number).min() > 30
    first, second, third = number.reshape(3, 200)
    for other in (second, third):
        assert np.mean(first == other) > 0.9
    pieces = 1 + np.count_nonzero(np.diff(np.append(first, first[0])))
    assert pieces <= 11, "a stretch is one piece of the lap"


def test_the_other_direction_and_another_track_are_other_places() -> None:
    there = circling(1, 200, 2.0)
    x = there.x[::-1].copy()
    x[:, 2] += np.pi
    back = Dataset(CAR, STEP_S, x, there.u, x)
    number = stretches(concatenate([there, back]), 10)
    assert not set(number[:200]) & set(number[200:])
    x = there.x + np.array([10.0, 0, 0, 0, 0, 0, 0])
    number = stretches(concatenate([there, Dataset(CAR, STEP_S, x, there.u, x)]), 10)
    assert not set(number[:200]) & set(number[200:])


@pytest.mark.parametrize("count", [2, 9, 10, 11, 100])
def test_a_place_that_holds_too_much_is_cut_by_time(count: int) -> None:
    """Samples without a place, such as those that weights recall, or a tiny circle."""
    still = circling(0, count, 1.0)
    number = stretches(still, 10)
    assert list(number) == sorted(number)
    assert len(set(number)) == min(count, 10)


def test_no_samples_have_no_stretch() -> None:
    assert len(stretches(circling(1, 0, 2.0), 10)) == 0


# Calibration ---------------------------------------------------------------------------------


def test_an_interval_is_not_judged_by_the_errors_that_it_was_fitted_to() -> None:
    """One stretch of ten that is not understood at all: its errors are no reason to be covered."""
    random = np.random.default_rng(0)
    error = random.normal(size=1000)
    error[900:] *= 50
    folds = np.arange(1000) // 100
    raw = PredictionErrors(error, np.ones(1000))
    whole = replace(raw, sigma=raw.sigma * np.sqrt(raw.variance_scale))
    assert whole.metrics(error)["coverage"] == pytest.approx(0.95, abs=0.001)
    scaled = raw.calibrated(folds)
    assert np.mean(np.abs(scaled.error[900:]) < 1.96 * scaled.sigma[900:]) < 0.15
    assert scaled.sigma[900:] == pytest.approx(
        np.sqrt(PredictionErrors(error[:900], raw.sigma[:900]).variance_scale)
    )
    assert scaled.log_density < whole.log_density


def test_calibration_widens_and_never_narrows() -> None:
    error, folds = np.random.default_rng(1).normal(size=200), np.arange(200) // 20
    wide = PredictionErrors(error, np.full(200, 5.0))
    assert wide.calibrated(folds).sigma == pytest.approx(wide.sigma)
    narrow = PredictionErrors(error, np.full(200, 0.1))
    assert 0.9 < narrow.calibrated(folds).metrics(error)["coverage"] < 1
    alone = narrow.calibrated(np.zeros(200, dtype=np.int64))
    assert alone.sigma == pytest.approx(0.1), "no other fold to learn the scale from"


def test_scores_do_not_depend_on_the_unit() -> None:
    """Scaled targets give the scores of the residual that they are made from."""
    random = np.random.default_rng(2)
    truth, error, sigma = random.normal(size=(3, 50))
    for noise in (0.0, 0.1 * error**2):
        one = PredictionErrors(error, np.abs(sigma), noise)
        four = PredictionErrors(4 * error, 4 * np.abs(sigma), 16 * noise)
        scaled, plain = one.metrics(truth, offset=0.3, scale=4.0), four.metrics(0.3 + 4 * truth)
        assert scaled == pytest.approx(plain)


# What is reported ------------------------------------------------------------------------------


def test_laps_driven_again_do_not_improve_the_reported_metrics() -> None:
    """The same place driven thrice teaches the next lap, not another track."""
    laps = [drive(dynamic(CAR), 160, seed=1, vx=vx) for vx in (1.5, 1.501, 1.499)]
    one, three = (train(data, PREDICTION, QUICK) for data in (laps[0], concatenate(laps)))
    again = validate(three, drive(dynamic(CAR), 160, seed=1, vx=1.5005), PREDICTION).metrics
    for output in OUTPUTS:
        reported = three.metrics[output]
        assert reported["rmse"] > 0.4 * one.metrics[output]["rmse"]
        assert reported["rmse"] > 3 * again[output]["rmse"]
        assert reported["log_density"] < again[output]["log_density"]


# Lap by lap ---------------------------------------------------------------------------------------


SMALL = TrainingSettings(**{**QUICK.model_dump(), "capacity": 60})


@pytest.fixture(scope="module")
def longer() -> Dataset:
    return drive(dynamic(CAR), 300, seed=1)


@pytest.fixture(scope="module")
def learned(longer: Dataset) -> Weights:
    return train(longer, PREDICTION, SMALL)


def test_as_many_are_kept_as_wanted(longer: Dataset) -> None:
    assert bounded(longer, len(longer)) is longer
    assert len(bounded(longer, 100)) == 100
    many = longer.select(np.arange(MOST_NEW + 5000) % len(longer))
    assert len(bounded(many, 50)) == 50


def test_the_newest_and_the_most_informative_are_kept(longer: Dataset, learned: Weights) -> None:
    """One sample unlike all others, long ago, among hundreds of one kind, is not let go."""
    same = longer.select(np.full(400, 7))
    x, x_next = same.x.copy(), same.x_next.copy()
    x[3, 5] += 4.0
    x_next[3, 5] += 4.0
    kept = bounded(replace(same, x=x, x_next=x_next), 40, learned)
    assert len(kept) == 40
    assert kept.x[:, 5].max() == x[3, 5]
    both = concatenate([same, longer])
    kept = bounded(both, 100, learned)
    assert len(kept) == 100
    np.testing.assert_array_equal(kept.x[-25:], longer.x[-25:])
    spread = [np.ptp(one.features, axis=0) for one in (kept, longer)]
    assert (spread[0] > 0.8 * spread[1]).all(), "the wealth of the drive is lost"


def test_laps_without_end_need_no_more_memory(learned: Weights) -> None:
    """The bound that is stated: samples times a quarter of what is kept, in doubles, and little."""
    wanted, kept = 200, drive(dynamic(CAR), 100, seed=2)
    lap = drive(dynamic(CAR), 300, seed=3)
    tracemalloc.start()
    for _ in range(10):
        kept = bounded(concatenate([kept, lap]), wanted, learned)
        assert len(kept) == wanted
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * (wanted + 300) * wanted / 4 + 2e6


def test_recalled_samples_teach_what_the_weights_know(longer: Dataset, learned: Weights) -> None:
    samples = recalled(learned, CAR)
    known = residual(samples, PREDICTION)
    np.testing.assert_allclose(known, evaluate_mean(learned, samples.features), atol=1e-12)
    again = train(samples, PREDICTION, SMALL)
    z = longer.features[::7]
    truth, before, after = (
        residual(longer, PREDICTION)[::7], evaluate_mean(learned, z), evaluate_mean(again, z)
    )  # fmt: skip
    rms = [np.sqrt(np.mean((one - truth) ** 2, axis=0)) for one in (before, after)]
    assert (rms[1] < 2 * rms[0] + 0.1 * truth.std(axis=0)).all()


def test_weights_that_know_nothing_recall_nothing() -> None:
    name = PREDICTION.identity("e_kinematic", CAR)
    assert len(recalled(zero_weights(CAR.name, name), CAR)) == 0


def test_a_task_learns_from_old_and_new(tmp_path: Path, longer: Dataset, learned: Weights) -> None:
    write_weights(tmp_path / "first.bin", learned)
    samples = [longer.select(slice(0, 150)), longer.select(slice(150, None))]
    outcome = perform(PREDICTION, samples, tmp_path / "first.bin", SMALL, keep=150)
    assert (outcome.error, outcome.samples) == ("", 300)
    assert outcome.weights is not None
    assert outcome.weights.counts == (60, 60, 60)
    assert outcome.kept is not None
    assert len(outcome.kept) == 150


def test_what_cannot_be_learned_from_is_kept_all_the_same(longer: Dataset) -> None:
    outcome = perform(PREDICTION, [longer.select(slice(0, 5))], None, SMALL, keep=150)
    assert "5 samples" in outcome.error
    assert outcome.weights is None
    assert outcome.kept is not None
    assert len(outcome.kept) == 5


# The process ---------------------------------------------------------------------------------


def outcome_of(trainer: Trainer) -> Outcome:
    found: list[Outcome] = []

    def poll() -> bool:
        found.extend(filter(None, [trainer.poll()]))
        return bool(found)

    until(poll, "an outcome")
    assert not trainer.busy
    return found[0]


@pytest.mark.check
def test_training_is_a_niced_process_that_may_die_or_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, samples = Trainer(), [drive(dynamic(CAR), 120, seed=1)]
    task = partial(perform, PREDICTION, samples, settings=QUICK, keep=60)

    def start(initial: Path | None = None) -> int:
        trainer.start(partial(task, initial=initial))
        return process_of(trainer)

    try:
        pid = start()
        first = outcome_of(trainer)
        assert first.kept is not None
        assert (first.error, first.samples, len(first.kept)) == ("", 120, 60)
        assert os.getpriority(os.PRIO_PROCESS, pid) == NICE
        assert start(initial=tmp_path / "gone.bin") == pid
        assert "gone.bin" in outcome_of(trainer).error
        trainer.start(partial(divmod, 1, 0))
        assert outcome_of(trainer).error.startswith("the training failed: ZeroDivisionError: ")
        os.kill(pid, signal.SIGSTOP)  # else it might be done before it is killed
        start()
        os.kill(pid, signal.SIGKILL)
        died = outcome_of(trainer)
        assert (died.error, died.kept) == ("the training was killed by signal 9", None)
        os.kill(start(), signal.SIGSTOP)
        monkeypatch.setattr("bayesrace.learning.training._LONGEST_S", 0.5)
        assert "no result after 0 s and was killed" in outcome_of(trainer).error
        monkeypatch.undo()
        start()
        again = outcome_of(trainer)
        assert first.weights is not None
        assert again.weights is not None
        assert again.weights.version == first.weights.version, "the same samples and weights"
        pid = process_of(trainer)
    finally:
        trainer.stop()
    assert not Path(f"/proc/{pid}").exists()


def process_of(trainer: Trainer) -> int:
    trainer.prepare()
    return trainer._process.pid or 0
