"""What the checks refuse and what they let through, without a process.

Promises guarded: weights with a sign flipped, outputs exchanged, a wrong size, an offset, of
another car, older than those in use, absurd or overflowing never pass, honest ones always do.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.checks import (
    NO_SAMPLES,
    Checks,
    Samples,
    Verdict,
    compare,
    plausible_features,
    slack_of,
)
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpOutput, Weights, encode_weights, zero_weights
from bayesrace.vehicles import Car
from tests.conftest import fit_weights
from tests.takeover.rig import KINDS
from tests.takeover.spoilt_weights import SPOILT, spoilt


@pytest.fixture(scope="module")
def drive(car: Car) -> Samples:
    """600 samples of a drive that nothing here was learned from."""
    found = fit_weights(car, KINDS, count=600, seed=7)
    features, residuals = found.sample_features, found.sample_residuals
    return Samples(features, residuals, np.zeros_like(residuals))


@pytest.fixture(scope="module")
def honest(car: Car) -> Weights:
    return fit_weights(car, KINDS, count=300, seed=1)


@pytest.fixture(scope="module")
def checks(kinematic_artefact: Path, car: Car) -> Checks:
    return Checks(GateSettings(), kinematic_artefact, car)


def file(weights: Weights | None) -> bytes:
    return b"" if weights is None else encode_weights(weights)


def judged(
    checks: Checks,
    weights: Weights,
    in_use: Weights | None = None,
    samples: Samples = NO_SAMPLES,
    proven: Weights | None = None,
    accepted_utc_ns: int = 2**62,
) -> Verdict:
    """On weights beside those in use, which are proven unless others are."""
    before = file(in_use), file(proven or in_use)
    return checks.judge(file(weights), samples, *before, accepted_utc_ns)


# Checks --------------------------------------------------------------------------------------


def test_honest_weights_pass(
    checks: Checks, honest: Weights, again: Weights, drive: Samples
) -> None:
    for weights, in_use in ((honest, None), (again, None), (honest, again), (again, honest)):
        verdict = judged(checks, weights, in_use, drive)
        assert verdict.packed, verdict.text
        assert verdict.data["probation"] is False
        assert verdict.data["samples"] == 600
        for name in ("vx", "vy", "omega"):
            assert f"{name} " in verdict.text
            new, nominal = (verdict.data[f"error_{what}_{name}"] for what in ("new", "nominal"))
            assert float(new) < float(nominal)


@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_are_refused_in_favour_of_good_ones(
    checks: Checks, honest: Weights, again: Weights, drive: Samples, what: str
) -> None:
    verdict = judged(checks, spoilt(again, what), honest, drive)
    assert not verdict.packed
    assert "worse than those in use" in verdict.text or "absurd" in verdict.text


@pytest.mark.parametrize("what", [name for name in SPOILT if not name.startswith("offset")])
def test_spoilt_weights_are_refused_in_favour_of_none(
    checks: Checks, honest: Weights, drive: Samples, what: str
) -> None:
    assert not judged(checks, spoilt(honest, what), None, drive).packed


@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_do_not_drive_from_the_start(
    checks: Checks, honest: Weights, what: str
) -> None:
    """There is no recent driving yet: they are checked by the samples in their file."""
    checks.check_start(file(honest))
    with pytest.raises(InputError, match=r"worse than no correction|absurd"):
        checks.check_start(file(replace(honest, outputs=SPOILT[what](honest.outputs))))


def test_weights_that_nothing_can_check_do_not_drive_from_the_start(
    checks: Checks, honest: Weights
) -> None:
    checks.check_start(file(zero_weights(honest.car, honest.discretisation)))
    without = replace(honest, sample_features=np.zeros((0, 6)), sample_residuals=np.zeros((0, 3)))
    with pytest.raises(InputError, match="hold no samples that they can be checked by"):
        checks.check_start(file(without))
    with pytest.raises(InputError, match="y_scale"):  # its square would not be finite
        replace(honest.outputs[0], y_scale=1e300)


def test_good_weights_count_beside_those_in_use_that_may_be_bad(
    checks: Checks, honest: Weights, again: Weights, drive: Samples
) -> None:
    """Bad weights on probation are no measure for others."""
    bad = spoilt(honest, "flip omega")
    as_bad = spoilt(again, "flip omega")
    assert judged(checks, as_bad, bad, drive).packed
    assert not judged(checks, as_bad, bad, drive, proven=honest).packed


@pytest.mark.parametrize("count", [0, 49])
def test_with_few_samples_weights_are_accepted_on_probation(
    checks: Checks, honest: Weights, drive: Samples, count: int
) -> None:
    few = Samples(*(one[:count] for one in drive))
    verdict = judged(checks, spoilt(honest, "flip vy"), None, few)
    assert verdict.packed
    assert (verdict.data["samples"], verdict.data["probation"]) == (count, True)
    assert "on probation" in verdict.text


def test_stale_weights_are_refused(checks: Checks, honest: Weights, drive: Samples) -> None:
    newer = replace(honest, version="newer", created_utc_ns=2_000_000_000)
    for created, accepted in ((1_000_000_000, False), (2_000_000_000, True), (0, True)):
        weights = replace(honest, created_utc_ns=created)
        for samples in (drive, NO_SAMPLES):
            verdict = judged(checks, weights, newer, samples)
            assert bool(verdict.packed) is accepted
            assert accepted or "stale: made 1 s before those in use, 'newer'" in verdict.text


def test_weights_dated_ahead_do_not_make_later_ones_stale(checks: Checks, honest: Weights) -> None:
    now_ns = time.time_ns()
    ahead = replace(honest, version="ahead", created_utc_ns=now_ns + 3000 * 10**9)
    assert judged(checks, ahead).packed
    for after_ns, accepted in ((10**9, True), (-(10**9), False)):
        weights = replace(honest, created_utc_ns=now_ns + after_ns)
        assert bool(judged(checks, weights, ahead, accepted_utc_ns=now_ns).packed) is accepted


def test_weights_of_another_car_or_model_are_refused(checks: Checks, honest: Weights) -> None:
    other = replace(honest, car="rover")
    assert "those of the car 'rover'" in judged(checks, other).text
    other = replace(honest, discretisation="e_kinematic/rk4x1/0.05s/orca-0")
    verdict = judged(checks, other)
    assert (bool(verdict.packed), "were learned for" in verdict.text) == (False, True)


def test_weights_that_do_not_fit_are_refused(checks: Checks, honest: Weights) -> None:
    vx, vy, omega = honest.outputs
    large = replace(vx, inputs=np.zeros((1025, 6)), alpha=np.zeros(1025))
    verdict = judged(checks, replace(honest, outputs=(large, vy, omega)))
    assert (bool(verdict.packed), "1025 points" in verdict.text) == (False, True)


@pytest.mark.parametrize("factor", [30.0, 1e6, 1e300])
def test_absurd_weights_are_refused_without_any_sample(
    checks: Checks, honest: Weights, factor: float
) -> None:
    """1e300: finite numbers that overflow once scaled, or in the sum."""
    vx, vy, omega = honest.outputs
    huge: GpOutput = replace(omega, alpha=omega.alpha * factor)
    verdict = judged(checks, replace(honest, outputs=(vx, vy, huge)))
    assert not verdict.packed
    assert "absurd" in verdict.text or "unusable" in verdict.text


def test_what_is_absurd_only_where_the_car_is_is_refused(
    checks: Checks, honest: Weights, drive: Samples, car: Car
) -> None:
    """A spike too narrow for the states all over its range."""
    vx, vy, omega = honest.outputs
    spike = drive.features[-3]
    narrow = replace(vx, length_scales=np.full(6, 1e-3), inputs=spike[None], alpha=np.array([1e3]))
    weights = replace(honest, outputs=(narrow, vy, omega))
    assert judged(checks, weights).packed
    verdict = judged(checks, weights, None, drive)
    assert (bool(verdict.packed), "absurd in its recent states" in verdict.text) == (False, True)


def test_plausible_states_are_within_the_cars_limits(car: Car) -> None:
    z = plausible_features(car, 200)
    assert np.abs(z[:, 3]).max() <= car.delta_max_rad
    assert car.d_min <= z[:, 4].min() < z[:, 4].max() <= car.d_max
    assert 2.0 < z[:, 0].max() < 6.0
    assert plausible_features(car, 200).tobytes() == z.tobytes()


def test_an_error_that_is_not_finite_is_worse_than_anything() -> None:
    infinite, fine, settings = [np.inf] * 3, [1.0] * 3, GateSettings()
    for old in (fine, infinite):
        found = compare(settings, np.zeros(3), 20, infinite, old, fine)
        assert found.worse == "vx and vy and omega"


@pytest.mark.parametrize(("count", "factor"), [(5, 20.0), (20, 5.0), (100, 1.0), (200, 1.0)])
def test_fewer_samples_must_be_worse_by_as_much_in_all(car: Car, count: int, factor: float) -> None:
    """The resolution holds for a window of samples; fewer ones have as much excess together."""
    none, slack, settings = [0.0] * 3, slack_of(car, 0.02), GateSettings()
    for share, worse in ((0.99, ""), (1.01, "vx and vy and omega")):
        excess = share * factor * slack
        assert compare(settings, slack, count, excess, none, none).worse == worse
