"""Folds of cross-validation, calibrated intervals, and the meaning of the reported metrics."""

from dataclasses import replace

import numpy as np
import pytest

from bayesrace.gp.weights import OUTPUTS
from bayesrace.integrators import PREDICTION
from bayesrace.vehicles.models import dynamic
from learning.dataset import Dataset, concatenate
from learning.subset import stretches
from learning.target import PredictionErrors
from learning.training import train
from learning.validation import validate
from tests.driven import CAR, QUICK, STEP_S, drive


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
    scaled = PredictionErrors(error, np.abs(sigma)).metrics(truth, offset=0.3, scale=4.0)
    plain = PredictionErrors(4 * error, 4 * np.abs(sigma)).metrics(0.3 + 4 * truth)
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
