"""The watch over adopted weights, with the compiled controller that keeps both sets.

Promises guarded: spoilt weights are rolled back within a second of driving and honest ones never;
the car goes back only to what is no worse; going back restores the weights to the bit.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import make_path_table
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import SAMPLES, WATCHED, GateSettings, MpcSettings
from bayesrace.controller.weights.adoption import Ruling, Watch
from bayesrace.gp.weights import Weights, pack_weights, zero_weights
from bayesrace.vehicles import Car
from tests.conftest import Circuit, fit_weights, smooth_drive
from tests.takeover.rig import KINDS
from tests.takeover.spoilt_weights import SPOILT, spoilt

STEP_S = 0.02
RESOLUTION = np.array([0.002, 0.004, 0.04])
LIMIT_SAMPLES = 40
"""Within which the watch has to roll spoilt weights back; the car starts at 1.5 m/s."""

Drive = tuple[Floats, Floats]


@pytest.fixture(scope="module")
def drive(car: Car) -> Drive:
    """States (601, 7) and inputs of a drive that nothing here was learned from."""
    return smooth_drive(car, 601, seed=7)


@pytest.fixture(scope="module")
def honest(car: Car) -> Weights:
    return fit_weights(car, KINDS, count=300, seed=1)


@pytest.fixture
def step(kinematic_artefact: Path, car: Car, circuit: Circuit) -> NativeStep:
    """One that has been stepped, as it is between two cycles."""
    native = NativeStep(kinematic_artefact, car, MpcSettings())
    spacing_m = car.tuning.path.spacing_m
    native.set_path(make_path_table(circuit.track, circuit.line, spacing_m))
    native.step(circuit.start(), 0.0)
    return native


def adopt(step: NativeStep, new: Weights) -> None:
    packed = pack_weights(new)
    step.stage_weights(packed)
    step.adopt_weights()


def compared(step: NativeStep, car: Car) -> Any:
    """What a watch compares."""
    watch = Watch(GateSettings(), car, step)
    watch.look()
    found = watch.trial.found
    names = ("in_use", "proven", "nominal")
    whole = {"samples": found.samples, "fresh": found.fresh}
    return SimpleNamespace(**whole, **{name: list(getattr(found, name)) for name in names})


def show(
    step: NativeStep, drive: Drive, first: int = 0, last: int = 600, noise: Floats | None = None
) -> Iterator[int]:
    """The drive to the controller, sample by sample; ``noise`` (n, 7): of each."""
    x, u = drive
    for k in range(first, last):
        step.observe(x[k], u[k], STEP_S, x[k + 1], None if noise is None else noise[k])
        step.prepare()
        yield k


def watched(
    step: NativeStep, car: Car, drive: Drive, new: Weights, old: Weights,
    before: int = 0,
) -> list[tuple[int, Ruling]]:  # fmt: skip
    """What the watch finds, after how many samples, up to a rollback or to the proof; so many
    samples are from before the adoption."""
    step.set_weights(old)
    list(show(step, drive, last=before))
    adopt(step, new)
    watch = Watch(GateSettings(), car, step)
    found: list[tuple[int, Ruling]] = []
    for k in show(step, drive, first=before):
        watch.observe(float(drive[0][k, 3]), False)
        if (ruling := watch.look()) is not None:
            found.append((k + 1 - before, ruling))
            if ruling.action != "slow":
                break
    return found


def test_the_errors_are_those_of_the_weights(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights, car: Car
) -> None:
    """Against the residuals and the posterior means, each computed on its own."""
    reference = fit_weights(car, KINDS, count=600, seed=7)
    step.set_weights(again)
    adopt(step, honest)
    list(show(step, drive, last=90))
    features, residuals, noise = step.samples()
    assert not noise.any()
    np.testing.assert_allclose(features, reference.sample_features[:90], rtol=0, atol=1e-12)
    np.testing.assert_allclose(residuals, reference.sample_residuals[:90], rtol=0, atol=1e-9)
    found = compared(step, car)
    assert (found.samples, found.fresh) == (90, 90)
    rms = np.sqrt((residuals**2).mean(axis=0))
    assert list(found.nominal) == pytest.approx(rms.tolist(), rel=1e-9)
    for errors in (found.in_use, found.proven):
        assert all(0 < one < 0.5 * all_of for one, all_of in zip(errors, rms, strict=True))


def test_what_noise_explains_is_no_error(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights, car: Car
) -> None:
    """Against the formula: each square less the noise, by 1 / (1 + noise / resolution^2)."""
    noise = np.random.default_rng(2).uniform(0, 4e-5, (90, 7))
    step.set_weights(again)
    adopt(step, honest)
    list(show(step, drive, last=90, noise=noise))
    _, residuals, stated = step.samples()
    np.testing.assert_allclose(stated, noise[:, 3:6], rtol=1e-9)
    found = compared(step, car)
    weight = 1 / (1 + stated / RESOLUTION**2)
    beyond = (weight * (residuals**2 - stated)).sum(axis=0) / weight.sum(axis=0)
    assert list(found.nominal) == pytest.approx(np.sqrt(beyond).tolist(), rel=1e-9)
    noise[:] = 1.0  # more than all errors
    list(show(step, drive, 90, 90 + WATCHED, np.tile(noise, (3, 1))))
    found = compared(step, car)
    assert [*found.in_use, *found.proven, *found.nominal] == [0.0] * 9


def test_states_are_estimated_by_the_proven_weights_while_others_are_watched(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights
) -> None:
    v = np.concatenate([drive[0][100], drive[1][100]])

    def believed() -> bytes:
        after, *_ = step.propagate(v[:7], v[7:], STEP_S, np.zeros(3))
        return after.tobytes() + b"".join(one.tobytes() for one in step.variance(v))

    found = []
    for weights in (honest, again):
        step.set_weights(weights)
        found.append(believed())
    step.set_weights(honest)
    adopt(step, again)
    assert believed() == found[0] != found[1]
    step.prove_weights()
    assert believed() == found[1]
    step.set_weights(zero_weights(honest.car, honest.discretisation))
    adopt(step, again)  # nothing is proven
    assert believed() == found[1]


def test_the_newest_samples_are_kept(
    step: NativeStep, drive: Drive, honest: Weights, car: Car
) -> None:
    list(show(step, drive))
    features, _, _ = step.samples()
    assert len(features) == SAMPLES
    np.testing.assert_array_equal(features[:, :4], drive[0][600 - SAMPLES : 600, 3:])
    adopt(step, honest)
    found = compared(step, car)
    assert (found.samples, found.fresh) == (0, 0)
    for _ in range(WATCHED):
        step.prepare()
    assert compared(step, car).samples == WATCHED


def test_the_watch_keeps_honest_weights(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights, car: Car
) -> None:
    none = zero_weights(honest.car, honest.discretisation)
    for new, old in ((honest, none), (again, none), (honest, again), (honest, honest)):
        for before in (0, 60):
            found = watched(step, car, drive, new, old, before)
            assert [ruling.action for _, ruling in found] == ["proven"]


@pytest.mark.parametrize("what", SPOILT)
def test_the_watch_rolls_spoilt_weights_back(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights, car: Car,
    what: str,
) -> None:  # fmt: skip
    ((count, ruling),) = watched(step, car, drive, spoilt(again, what), honest)
    assert (ruling.action, 5 <= count <= LIMIT_SAMPLES) == ("back", True)
    assert "worse" in ruling.text


def test_the_watch_goes_back_only_to_what_is_no_worse(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights, car: Car
) -> None:
    """Wrong in vx alone, weights are still better than none: the car slows down, once, and they
    are never proven."""
    none = zero_weights(honest.car, honest.discretisation)
    for reference, actions in ((none, ["slow"]), (honest, ["back"])):
        found = watched(step, car, drive, spoilt(again, "flip vx"), reference)
        assert [ruling.action for _, ruling in found] == actions
        assert "predicted vx worse" in found[0][1].text
    assert float(found[0][1].data["fastest_mps"]) > 1


def test_the_watch_rolls_back_what_leaves_no_solution(
    step: NativeStep, honest: Weights, car: Car
) -> None:
    """A car that stands has no error by which weights could be judged."""
    adopt(step, honest)
    for falls, actions in (([None] * 1000, 0), ([True] * 25, 1), ([True, False] * 500, 0)):
        watch, found = Watch(GateSettings(), car, step), 0
        for fallen_back in falls:
            watch.observe(0.0, fallen_back)
            found += watch.look() is not None
        assert found == actions


def test_going_back_restores_the_proven_weights_to_the_bit(
    step: NativeStep, drive: Drive, honest: Weights, again: Weights
) -> None:
    """Also where others have been adopted, and staged, in the meantime."""
    x, u = drive[0][100], drive[1][100]

    def predicted() -> bytes:
        return step.predict(x, u, STEP_S).tobytes()

    step.set_weights(honest)
    proven = predicted()
    adopt(step, again)
    other = predicted()
    adopt(step, replace(again, version="next"))
    staged = pack_weights(spoilt(again, "scale 3"))
    step.stage_weights(staged)
    assert predicted() == other != proven
    step.revert_weights()
    assert predicted() == proven
    step.adopt_weights()
    assert predicted() not in (other, proven)
    step.prove_weights()
    step.revert_weights()
    assert predicted() not in (other, proven)
