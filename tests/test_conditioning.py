"""Weights conditioned on readings, against dense conditioning, and against what is learned from
smoothed states."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.gp.expression import evaluate_mean, kernel_matrix
from bayesrace.gp.weights import GpOutput, Weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning import conditioning
from bayesrace.learning.conditioning import conditioned
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.drives import Drive, Estimates
from bayesrace.learning.estimates import smoothed_again
from bayesrace.learning.kalman import Smoothed
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.smoothing import corrected_steps, smooth
from bayesrace.learning.training import fit
from bayesrace.learning.validation import predictive_sigma, residual
from bayesrace.vehicles import Car
from tests.conftest import Make, smooth_drive
from tests.driven import STEP_S
from tests.racing import prepared, racing
from tests.test_smoothing import NAMES, POSE, of, read, samples_of, seen

MIRROR = np.array([1, -1, -1, -1, 1, -1])
PARITY = (1, -1, -1)
ROUGH = (0.001, 0.001, np.deg2rad(0.5))
UNKNOWN = (5, 6)
"""Periods that are not learned from."""
ALIKE = 8
"""Smoothed states count as one of so many."""
SHARE = 0.5
"""Of the noise of weights, what is their model's."""


def short_drive(make: Make, car: Car) -> tuple[Floats, Floats, Drive]:
    """Poses within periods, and a gyro at their ends; one of the poses is nowhere near."""
    random, step = np.random.default_rng(2), make()
    _, u = smooth_drive(car, 14, 2)
    x, readings = [np.array([0.3, -0.2, 3.0, 1.5, 0, 0, 0])], []
    for k, given in enumerate(u):
        part, end = (step.predict(x[-1], given, h) for h in (0.007, STEP_S))
        off = 0.3 * np.eye(7)[0] * (k == 9)
        readings.append(read(random, STEP_S * k + 0.007, NAMES[:3], part + off, POSE))
        readings.append(read(random, STEP_S * (k + 1), ("omega",), end, (0.02,)))
        x.append(end)
    return np.array(x), u, of(np.array(x), u, readings)


def dense(
    weights: Weights, made: Weights, samples: Dataset, drive: Drive, z: Floats, images: bool
) -> tuple[Floats, Floats]:
    """Means and variances (n, 3) of the correction at ``z`` (n, 6): the joint Gaussian of it, the
    start and all noise, conditioned on all readings and samples at once. In the :data:`UNKNOWN`
    periods it may be anything.

    ``made``: has the points that span the corrections.
    """
    car, path = samples.car, drive.path
    assert path is not None
    events = drive.events
    u, h = np.array([one.u for one in events[1:]]), np.array([one.duration_s for one in events[1:]])
    ends = [i if i == 0 or one.period >= 0 else 0 for i, one in enumerate(events[:-1])]
    begin = path[np.maximum.accumulate(ends), :7]
    step = corrected_steps(path[:-1, :7], begin, u, h, car, PREDICTION, weights)
    features = np.column_stack([begin[:, 3:], u])
    places, e = np.vstack([z, samples.features, features]), len(h)
    new, known = len(z), len(z) + len(samples)
    priors, alone, offsets = [], [], []
    for before, after, parity in zip(weights.outputs, made.outputs, PARITY, strict=True):
        spanned, own, offset = prior(before, after, places, parity if images else 0)
        ended = np.cumsum([one.period >= 0 for one in events])[:-1]
        unknown = known + np.flatnonzero(np.isin(ended, UNKNOWN))
        own[unknown] += np.diag(spanned)[unknown]
        spanned[unknown], spanned[:, unknown] = 0, 0
        priors.append(spanned)
        alone.append(own + SHARE * before.noise_variance * before.y_scale**2)
        offsets.append(offset)
    n, settings = len(places), car.tuning.estimation(nominal=False)
    sizes = [n, n, n, 9, *[3] * e, *[9] * e]
    at = np.cumsum([0, *sizes])
    covariance, mean = np.zeros((at[-1], at[-1])), np.zeros(at[-1])
    for k, block in enumerate(priors):
        covariance[at[k] : at[k + 1], at[k] : at[k + 1]] = block
        mean[at[k] : at[k + 1]] = offsets[k]
    p0 = np.diag(np.square(settings["start"]))
    p0[3:6] *= 100
    first = events[0].measured
    assert first is not None
    p0[:3, :3], p0[6, 6], p0[8, 8] = np.diag(first.variance), 0, 0
    x0 = np.r_[first.value, path[0, 3:6], first.time_s * drive.u[1, 1], 0, 0]
    covariance[at[3] : at[4], at[3] : at[4]], mean[at[3] : at[4]] = p0, x0
    for i in range(e):
        share = h[i] / STEP_S
        noise = np.diag([one[known + i] * share for one in alone])
        covariance[at[4 + i] : at[5 + i], at[4 + i] : at[5 + i]] = noise
        drift = np.diag(np.square(settings["drift"]) * h[i])
        covariance[at[4 + e + i] : at[5 + e + i], at[4 + e + i] : at[5 + e + i]] = drift
    state, constant = np.zeros((9, at[-1])), np.zeros(9)
    state[:, at[3] : at[4]] = np.eye(9)
    rows, values, variances = list[Floats](), list[float](), list[float]()
    assumed = evaluate_mean(weights, features)
    for i, event in enumerate(events[1:]):
        f, by_g = np.eye(9), np.zeros((9, 3))
        f[:7, :7], by_g[:7] = step.slope[i], step.by_error[i] * h[i] / STEP_S
        constant = f @ (constant - path[i, :9]) + np.r_[step.ahead[i], path[i, 7:9]]
        constant -= by_g @ assumed[i]
        state = f @ state
        for k in range(3):
            state[:, at[k] + known + i] += by_g[:, k]
        by_e = np.zeros((9, 3))
        by_e[:7] = step.by_error[i]
        state[:, at[4 + i] : at[5 + i]] += by_e
        state[:, at[4 + e + i] : at[5 + e + i]] += np.eye(9)
        for number, value, variance in zip(*(event.measured or [()] * 4)[1:4], strict=True):
            offset = number == 5
            rows.append(state[number] + offset * state[7])
            error = value - constant[number] - offset * constant[7]
            turns = np.round((error - rows[-1] @ mean) / (2 * np.pi)) * (number == 2)
            values.append(error - 2 * np.pi * turns)
            variances.append(variance)
    target = residual(samples, PREDICTION)
    for j in range(len(samples)):
        for k in range(3):
            rows.append(np.eye(at[-1])[at[k] + new + j])
            values.append(target[j, k])
            variances.append(ALIKE * samples.deviation[j, k] ** 2 + alone[k][new + j])
    seen_by = np.array(rows)
    across = covariance @ seen_by.T
    gain = np.linalg.solve(seen_by @ across + np.diag(variances), across.T).T
    mean = mean + gain @ (np.array(values) - seen_by @ mean)
    left = np.diag(covariance - gain @ across.T)
    here = [slice(at[k], at[k] + new) for k in range(3)]
    shares = [SHARE * one.noise_variance * one.y_scale**2 for one in weights.outputs]
    found = [left[one] + alone[k][:new] - shares[k] for k, one in enumerate(here)]
    return np.column_stack([mean[one] for one in here]), np.column_stack(found)


def prior(
    before: GpOutput, after: GpOutput, places: Floats, parity: int
) -> tuple[Floats, Floats, float]:
    """Covariance (n, n) of the corrections that the points span, and the variances (n,) of the
    rest."""

    def between(a: Floats, b: Floats) -> Floats:
        found = kernel_matrix(before.kernel, a, b, before.length_scales)
        image = kernel_matrix(before.kernel, a, b * MIRROR, before.length_scales)
        return before.y_scale**2 * before.signal_variance * (found + parity * image)

    points = after.inputs[: after.count // 2] if parity else after.inputs
    own = between(points, points)
    own += 1e-6 * np.trace(own) / len(own) * np.eye(len(own))
    spanned = between(places, points) @ np.linalg.solve(own, between(points, places))
    rest = np.diag(between(places, places)) - np.diag(spanned)
    return spanned, np.maximum(rest, 0), 0.0 if parity < 0 else before.y_mean


@pytest.mark.parametrize("mirrored", [True, False])
def test_it_is_what_all_readings_and_samples_at_once_say(
    make: Make,
    car: Car,
    weights: Weights,
    mirrored: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The covariance of the weights is made anew several times in the drive."""
    monkeypatch.setattr(conditioning, "_LATER", 20)
    car = car.model_copy(update={"mirrored_samples": mirrored})
    x, u, drive = short_drive(make, car)
    found = smooth(drive, car, PREDICTION, weights)
    assert found is not None
    drive = replace(drive, path=found.path, refused=found.refused)
    assert found.refused.sum() == 1
    random = np.random.default_rng(3)
    settled = Estimates.settled(random.uniform(0.01, 0.05, (4, 4)))
    few = Dataset(car, STEP_S, x[:4], u[:4], random.normal(x[1:5], 0.02), estimates=settled)
    origin = np.column_stack([np.zeros(14, int), np.arange(14)])
    estimates = Estimates(np.full((14, 4), 0.01), origin, (drive,))
    smoothed = Dataset(car, STEP_S, x[:-1], u, x[1:], estimates=estimates)
    smoothed = smoothed.select(~np.isin(np.arange(14), UNKNOWN))
    made = conditioned(
        weights, concatenate([few, smoothed]), PREDICTION, 10 if mirrored else 5, SHARE
    )
    assert [one.count for one in made.outputs] == [10 if mirrored else 5] * 3
    z = concatenate([few, smoothed]).features
    mean, variance = dense(weights, made, few, drive, z, mirrored)
    scale = np.sqrt(variance)
    assert np.abs((evaluate_mean(made, z) - mean) / scale).max() < 1e-4
    if mirrored:
        image = evaluate_mean(made, z * MIRROR) * PARITY
        np.testing.assert_allclose(evaluate_mean(made, z), image, atol=1e-12)
    stated = latent(made, z)
    np.testing.assert_allclose(stated.mean(axis=0), variance.mean(axis=0), rtol=0.01)


def two_drives(make: Make, car: Car, weights: Weights) -> list[Dataset]:
    """Smoothed, as samples."""
    found = []
    for begin in (0, 7):
        x, u, drive = short_drive(make, car)
        x, u = x[begin:], u[begin:]
        kept = tuple(one for one in drive.readings if one.time_s > STEP_S * begin)
        moved = replace(drive, time_s=drive.time_s[begin:], u=drive.u[begin:], readings=kept)
        origin = np.column_stack([np.zeros(len(u), int), np.arange(len(u))])
        known = Estimates(np.full((len(u), 4), 0.01), origin, (moved,))
        found.append(Dataset(car, STEP_S, x[:-1], u, x[1:], estimates=known))
    return [smoothed_again(one, PREDICTION, weights) for one in found]


def test_the_order_of_drives_does_not_matter(make: Make, car: Car, weights: Weights) -> None:
    drives = two_drives(make, car, weights)
    z = np.vstack([one.features for one in drives])
    there, back, first = (
        evaluate_mean(conditioned(weights, concatenate(some), PREDICTION, 42, SHARE), z)
        for some in (drives, drives[::-1], drives[:1])
    )
    np.testing.assert_allclose(there, back, atol=1e-6)
    assert np.abs(there - first).max() > 1e-4


def test_samples_of_a_drive_that_the_model_cannot_follow_stay_as_they_are(
    make: Make, car: Car, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = two_drives(make, car, weights)
    both = concatenate([first, second])

    def only_the_first(drive: Drive, *rest: Any) -> Smoothed | None:
        return smooth(drive, *rest) if len(drive.time_s) > 10 else None

    monkeypatch.setattr("bayesrace.learning.estimates.smooth", only_the_first)
    found = smoothed_again(both, PREDICTION, weights).estimates
    assert found is not None
    assert len(found.drives) == 1
    np.testing.assert_array_equal(found.origin[:, 0], np.repeat([0, -1], [len(first), len(second)]))
    np.testing.assert_array_equal(found.deviation[len(first) :], second.deviation)


def latent(weights: Weights, z: Floats) -> Floats:
    """Variances (n, 3) of the corrections, without noise."""
    noise = [one.noise_variance * one.y_scale**2 for one in weights.outputs]
    return np.asarray(predictive_sigma(weights, z) ** 2 - noise)


@pytest.mark.check
@pytest.mark.parametrize("seed", range(3))
def test_a_mean_of_readings_errs_less_than_one_of_smoothed_states(seed: int) -> None:
    """And its variance is that of its errors, on a lap of another track."""
    race, training = racing(), prepared().training
    assert training is not None
    settings, lap = TrainingSettings(capacity=400), race.driven.samples()
    learned = samples_of(seen(training.samples, seed, ROUGH))
    both = learned, learned.settled()
    weights, before = (fit(one, PREDICTION, settings).weights for one in both)
    truth, z = residual(lap, PREDICTION), lap.features
    error, error_before = (truth - evaluate_mean(one, z) for one in (weights, before))
    assert ((error**2).mean(axis=0) < (0.7, 0.85, 0.6) * (error_before**2).mean(axis=0)).all()
    ratio = (error**2 / latent(weights, z)).mean(axis=0)
    assert (ratio > 0.2).all()
    assert (ratio < 3).all()
