"""What the checks refuse and what they let through, without a process: checks, watch, samples.

Promises guarded: weights with a sign flipped, outputs exchanged, a wrong size, an offset, of
another car, older than those in use, absurd or overflowing never pass, honest ones always do; the
watch rolls the former back within a second of driving and the latter never.
"""

import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

import msgpack
import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpOutput, GpWeights, encode_weights, zero_weights
from bayesrace.vehicles import CarParameters, get_car
from controller.weights.checks import Checks, Verdict, Watch
from controller.weights.prediction import Sample, Sampler, StateRecord, plausible_samples
from controller.weights.settings import GateSettings
from controller.weights.validator import Validator
from tests.conftest import fit_weights, smooth_drive
from tests.takeover.rig import KINDS
from tests.takeover.spoilt_weights import SPOILT, spoilt

STEP_S = 0.02
LIMIT_SAMPLES = 40
"""Within which the watch has to roll spoilt weights back; the car starts at 1.5 m/s."""


def records(states: Floats, inputs: Floats, step_s: float = STEP_S) -> list[StateRecord]:
    """The states as a plant sends them: each with the input of the period before."""
    applied = np.vstack((np.zeros(2), inputs[:-1]))
    return [
        StateRecord(k, 1, 1, k, k * step_s, 0, tuple(states[k]), tuple(applied[k]), True)
        for k in range(len(states))
    ]


def completed(states: Iterable[StateRecord]) -> list[Sample]:
    """The samples that a validator makes of them."""
    sampler = Sampler(STEP_S, get_car("orca"))
    return [sample for one in states if (sample := sampler.add(one)) is not None]


@pytest.fixture(scope="module")
def drive(car: CarParameters) -> list[Sample]:
    """600 samples of a drive that nothing here was learned from."""
    return completed(records(*smooth_drive(car, 601, seed=7)))


@pytest.fixture(scope="module")
def honest(car: CarParameters) -> GpWeights:
    return fit_weights(car, KINDS, count=300, seed=1)


@pytest.fixture(scope="module")
def checks(kinematic_artefact: Path, car: CarParameters) -> Checks:
    return Checks(GateSettings(), kinematic_artefact, car)


def file(weights: GpWeights | None) -> bytes:
    return b"" if weights is None else encode_weights(weights)


def judged(
    checks: Checks,
    weights: GpWeights,
    in_use: GpWeights | None = None,
    samples: list[Sample] | None = None,
    proven: GpWeights | None = None,
    accepted_utc_ns: int = 2**62,
) -> Verdict:
    """On weights beside those in use, which are proven unless others are."""
    checks.use(file(in_use), accepted_utc_ns, file(proven or in_use))
    return checks.judge(file(weights), samples or [])


# Checks --------------------------------------------------------------------------------------


def test_honest_weights_pass(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    for weights, in_use in ((honest, None), (again, None), (honest, again), (again, honest)):
        verdict = judged(checks, weights, in_use, drive)
        assert verdict.packed, verdict.text
        assert verdict.data["probation"] is False
        assert verdict.data["samples"] == 500
        for name in ("vx", "vy", "omega"):
            assert f"{name} " in verdict.text
            new, nominal = (verdict.data[f"error_{what}_{name}"] for what in ("new", "nominal"))
            assert float(new) < float(nominal)


@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_are_refused_in_favour_of_good_ones(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample], what: str
) -> None:
    verdict = judged(checks, spoilt(again, what), honest, drive)
    assert not verdict.packed
    assert "worse than those in use" in verdict.text or "absurd" in verdict.text


@pytest.mark.parametrize("what", [name for name in SPOILT if not name.startswith("offset")])
def test_spoilt_weights_are_refused_in_favour_of_none(
    checks: Checks, honest: GpWeights, drive: list[Sample], what: str
) -> None:
    assert not judged(checks, spoilt(honest, what), None, drive).packed


@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_do_not_drive_from_the_start(
    checks: Checks, honest: GpWeights, what: str
) -> None:
    """There is no recent driving yet: they are checked by the samples in their file."""
    checks.check_start(file(honest))
    with pytest.raises(InputError, match=r"worse than no correction|absurd"):
        checks.check_start(file(replace(honest, outputs=SPOILT[what](honest.outputs))))


def test_weights_that_nothing_can_check_do_not_drive_from_the_start(
    checks: Checks, honest: GpWeights
) -> None:
    checks.check_start(file(zero_weights(honest.car, honest.discretisation)))
    without = replace(honest, sample_features=np.zeros((0, 6)), sample_residuals=np.zeros((0, 3)))
    with pytest.raises(InputError, match="hold no samples that they can be checked by"):
        checks.check_start(file(without))
    with pytest.raises(InputError, match="y_scale"):  # its square would not be finite
        replace(honest.outputs[0], y_scale=1e300)


def test_good_weights_count_beside_those_in_use_that_may_be_bad(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    """Bad weights on probation are no measure for others."""
    bad = spoilt(honest, "flip omega")
    as_bad = spoilt(again, "flip omega")
    assert judged(checks, as_bad, bad, drive).packed
    assert not judged(checks, as_bad, bad, drive, proven=honest).packed


@pytest.mark.parametrize("count", [0, 49])
def test_with_few_samples_weights_are_accepted_on_probation(
    checks: Checks, honest: GpWeights, drive: list[Sample], count: int
) -> None:
    verdict = judged(checks, spoilt(honest, "flip vy"), None, drive[:count])
    assert verdict.packed
    assert (verdict.data["samples"], verdict.data["probation"]) == (count, True)
    assert "on probation" in verdict.text


def test_stale_weights_are_refused(checks: Checks, honest: GpWeights, drive: list[Sample]) -> None:
    newer = replace(honest, version="newer", created_utc_ns=2_000_000_000)
    for created, accepted in ((1_000_000_000, False), (2_000_000_000, True), (0, True)):
        weights = replace(honest, created_utc_ns=created)
        for samples in (drive, []):
            verdict = judged(checks, weights, newer, samples)
            assert bool(verdict.packed) is accepted
            assert accepted or "stale: made 1 s before those in use, 'newer'" in verdict.text


def test_weights_dated_ahead_do_not_make_later_ones_stale(
    checks: Checks, honest: GpWeights
) -> None:
    now_ns = time.time_ns()
    ahead = replace(honest, version="ahead", created_utc_ns=now_ns + 3000 * 10**9)
    assert judged(checks, ahead).packed
    for after_ns, accepted in ((10**9, True), (-(10**9), False)):
        weights = replace(honest, created_utc_ns=now_ns + after_ns)
        assert bool(judged(checks, weights, ahead, accepted_utc_ns=now_ns).packed) is accepted


def test_weights_of_another_car_or_model_are_refused(checks: Checks, honest: GpWeights) -> None:
    other = replace(honest, car="rover")
    assert "those of the car 'rover'" in judged(checks, other).text
    other = replace(honest, discretisation="e_kinematic/rk4x1/0.05s/orca-0")
    verdict = judged(checks, other)
    assert (bool(verdict.packed), "were learned for" in verdict.text) == (False, True)


def test_weights_that_do_not_fit_are_refused(checks: Checks, honest: GpWeights) -> None:
    vx, vy, omega = honest.outputs
    large = replace(vx, inputs=np.zeros((1025, 6)), alpha=np.zeros(1025))
    verdict = judged(checks, replace(honest, outputs=(large, vy, omega)))
    assert (bool(verdict.packed), "1025 points" in verdict.text) == (False, True)


@pytest.mark.parametrize("factor", [30.0, 1e6, 1e300])
def test_absurd_weights_are_refused_without_any_sample(
    checks: Checks, honest: GpWeights, factor: float
) -> None:
    """1e300: finite numbers that overflow once scaled, or in the sum."""
    vx, vy, omega = honest.outputs
    huge: GpOutput = replace(omega, alpha=omega.alpha * factor)
    verdict = judged(checks, replace(honest, outputs=(vx, vy, huge)))
    assert not verdict.packed
    assert "absurd" in verdict.text or "unusable" in verdict.text


def test_what_is_absurd_only_where_the_car_is_is_refused(
    checks: Checks, honest: GpWeights, drive: list[Sample], car: CarParameters
) -> None:
    """A spike too narrow for the states all over its range."""
    vx, vy, omega = honest.outputs
    sample = drive[-3]
    spike = np.r_[sample.x[3:7], sample.u]
    narrow = replace(vx, length_scales=np.full(6, 1e-3), inputs=spike[None], alpha=np.array([1e3]))
    weights = replace(honest, outputs=(narrow, vy, omega))
    assert judged(checks, weights).packed
    verdict = judged(checks, weights, None, drive)
    assert (bool(verdict.packed), "absurd in its recent states" in verdict.text) == (False, True)


def test_plausible_states_are_within_the_cars_limits(car: CarParameters) -> None:
    samples = plausible_samples(car, STEP_S, 200)
    x, u = np.array([s.x for s in samples]), np.array([s.u for s in samples])
    assert np.abs(x[:, 6]).max() <= car.delta_max_rad
    assert car.d_min <= u[:, 0].min() < u[:, 0].max() <= car.d_max
    assert 2.0 < x[:, 3].max() < 6.0
    assert np.array([s.x for s in plausible_samples(car, STEP_S, 200)]).tobytes() == x.tobytes()


def test_an_error_that_is_not_finite_is_worse_than_anything(checks: Checks) -> None:
    infinite, fine = np.full((20, 3), np.inf), np.ones((20, 3))
    for old in (fine, infinite):
        assert checks.compare(infinite, [old], fine).worse == "vx and vy and omega"
    assert checks.compare(fine, [fine], infinite).data["samples"] == 0


@pytest.mark.parametrize(("count", "factor"), [(5, 20.0), (20, 5.0), (100, 1.0), (200, 1.0)])
def test_fewer_samples_must_be_worse_by_as_much_in_all(
    checks: Checks, car: CarParameters, count: int, factor: float
) -> None:
    """The resolution holds for a window of samples; fewer ones have as much excess together."""
    none = np.zeros((count, 3))
    excess = np.array(car.tuning.gate.resolution) * STEP_S * factor
    assert checks.compare(none + 0.99 * excess, [none], none).worse == ""
    assert checks.compare(none + 1.01 * excess, [none], none).worse == "vx and vy and omega"


# Watch ---------------------------------------------------------------------------------------


def watched(
    checks: Checks, new: GpWeights, old: GpWeights | None, drive: list[Sample]
) -> int | None:
    """Samples until the weights are rolled back; None if they are proven."""
    checks.use(file(new), 2**62, file(old))
    watch = Watch(checks, [])
    for count, sample in enumerate(drive, 1):
        if watch.over:
            return None
        if watch.add(False, sample) is not None:
            return count
    raise AssertionError("the drive is too short")


def test_the_watch_keeps_honest_weights(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    for new, old in ((honest, None), (again, None), (honest, again), (honest, honest)):
        assert watched(checks, new, old, drive) is None


@pytest.mark.parametrize("what", SPOILT)
def test_the_watch_rolls_spoilt_weights_back(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample], what: str
) -> None:
    count = watched(checks, spoilt(again, what), honest, drive)
    assert count is not None
    assert 5 <= count <= LIMIT_SAMPLES


def test_the_watch_goes_back_only_to_what_is_no_worse(
    checks: Checks, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    """Wrong in vx alone, weights are still better than none: the car slows down, once, and they
    are never proven."""
    bad = spoilt(again, "flip vx")
    for reference, actions in ((None, ["slow"]), (honest, ["back"])):
        checks.use(file(bad), 2**62, file(reference))
        watch, rulings = Watch(checks, []), []
        for sample in drive:
            if (ruling := watch.add(False, sample)) is not None:
                rulings.append(ruling)
            if ruling is not None and ruling.action == "back":
                break
        assert [ruling.action for ruling in rulings] == actions
        assert "predicted vx worse" in rulings[0].text
        assert not watch.over
    assert int(rulings[0].data["samples"]) <= 100


class Messages:
    """A connection whose other end has sent all messages; keeps the answers."""

    def __init__(self, messages: Iterable[dict[str, Any]]) -> None:
        self._messages = iter(messages)
        self.answers: list[dict[str, Any]] = []

    def recv_bytes(self) -> bytes:
        """The next message."""
        for message in self._messages:
            return bytes(msgpack.packb(message))
        raise EOFError

    def send_bytes(self, data: bytes) -> None:
        """Keeps an answer."""
        self.answers.append(msgpack.unpackb(data))


def conversation(
    checks: Checks, car: CarParameters, in_use: GpWeights, states: list[StateRecord], chunk: int,
    slowed: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """What a validator answers to these states, so many at a time, with unproven weights in use."""
    context = {
        "in_use": file(in_use), "accepted_utc_ns": 2**62, "reference": b"", "watched": True,
        "begin": 0, "slowed": slowed,
    }  # fmt: skip
    parts = [states[first : first + chunk] for first in range(0, len(states), chunk)]
    connection = Messages([{"context": context}, *({"states": part} for part in parts)])
    with suppress(EOFError):
        Validator(cast(Connection, connection), checks, car).serve()
    return connection.answers[1:]


@pytest.mark.parametrize("chunk", [1, 64, 600])
def test_what_the_watch_finds_does_not_depend_on_when_states_come(
    checks: Checks, again: GpWeights, car: CarParameters, chunk: int
) -> None:
    """Slow down, and later back, may be found in one message."""
    states = records(*smooth_drive(car, 601, seed=7))
    states[300:] = [one._replace(fallen_back=True) for one in states[300:]]
    answers = conversation(checks, car, spoilt(again, "flip vx"), states, chunk)
    found = [ruling for answer in answers for ruling in answer["watch"]]
    assert [action for action, *_ in found] == ["slow", "back"]
    assert found[0][2]["driven"] == 10
    assert answers[-1]["seen"] is None


@pytest.mark.parametrize("slowed", [False, True])
def test_weights_are_proven_unless_the_car_was_slowed_down_because_of_them(
    checks: Checks, again: GpWeights, car: CarParameters, slowed: bool
) -> None:
    """Also where a validator has replaced the one that found that."""
    states = records(*smooth_drive(car, 601, seed=7))
    answers = conversation(checks, car, again, states, 64, slowed)
    found = [action for answer in answers for action, *_ in answer["watch"]]
    assert found == ([] if slowed else ["proven"])
    assert (answers[-1]["seen"] is None) == (not slowed)


def test_the_watch_rolls_back_what_leaves_no_solution(checks: Checks, honest: GpWeights) -> None:
    """A car that stands has no error by which weights could be judged."""
    checks.use(file(honest), 2**62, b"")
    watch = Watch(checks, [])
    assert not any(watch.add(None, None) for _ in range(1000))
    assert [watch.add(True, None) is None for _ in range(25)] == [True] * 24 + [False]
    watch = Watch(checks, [])
    assert not any(watch.add(k % 2 == 0, None) for k in range(1000))


# Samples -------------------------------------------------------------------------------------


def test_faster_states_are_joined_to_samples_of_one_step(car: CarParameters) -> None:
    count, per_step = 40, 10
    states, inputs = smooth_drive(car, count + 1, seed=3)
    dense_x = np.repeat(states, per_step, axis=0)
    dense_u = np.repeat(inputs, per_step, axis=0)
    joined = completed(records(dense_x, dense_u, STEP_S / per_step))
    direct = completed(records(states, inputs))
    assert len(joined) == len(direct) == count
    for one, other in zip(joined, direct, strict=True):
        assert one.duration_s == other.duration_s == STEP_S
        assert one.x.tobytes() == other.x.tobytes()
        assert one.u == pytest.approx(other.u, abs=1e-12)


def test_gaps_standstill_and_repeated_states_make_no_sample(car: CarParameters) -> None:
    row = records(*smooth_drive(car, 12, seed=3))
    lost = [*row[:4], *row[5:]]
    assert len(completed(lost)) == 9
    repeated = [*row[:5], row[4]._replace(seq=5)]
    assert len(completed(repeated)) == 4
    other_run = [*row[:5], *(one._replace(run=2) for one in row[5:])]
    assert len(completed(other_run)) == 10
    standing = [one._replace(x=(0.0, 0, 0, 0.04, 0, 0, 0)) for one in row]
    assert completed(standing) == []
