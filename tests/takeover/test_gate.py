"""What the gate refuses and what it lets through, without a process: checks, watch, samples.

Promises guarded: weights with a sign flipped, outputs exchanged, a wrong size, an offset, of
another car, older than those in use, absurd or overflowing never pass, honest ones always do; the
watch gives the former up within a second of driving and the latter never.
"""

import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesrace.gp.weights import GpOutput, GpWeights
from bayesrace.messages import State
from bayesrace.vehicles import CarParameters, get_car
from controller.gate.judge import Gate, Incumbent, Watch, compare
from controller.gate.memory import ALL_SEEN, Memory, Noted
from controller.gate.model import plausible_samples
from controller.gate.samples import Sample, Sampler
from controller.gate.settings import GateSettings
from tests.conftest import fit_weights, smooth_drive
from tests.takeover.rig import KINDS
from tests.takeover.spoilt_weights import SPOILT, spoilt

Floats = NDArray[np.float64]

STEP_S = 0.02
LIMIT_SAMPLES = 40
"""Within which the watch has to give spoilt weights up; the car starts at 1.5 m/s."""


def notes(states: Floats, inputs: Floats, step_s: float = STEP_S, begin: int = 0) -> list[Noted]:
    """The states as a plant tells them: each with the input of the period before."""
    applied = np.vstack((np.zeros(2), inputs[:-1]))
    return [
        Noted(begin + k, 1, 1, k, k * step_s, 0, tuple(states[k]), tuple(applied[k]), True)
        for k in range(len(states))
    ]


def completed(states: Iterable[Noted]) -> list[Sample]:
    """The samples that a gatekeeper makes of them."""
    sampler = Sampler(STEP_S, 0.05)
    return [sample for one in states if (sample := sampler.add(one)) is not None]


@pytest.fixture(scope="module")
def drive(car: CarParameters) -> list[Sample]:
    """600 samples of a drive that nothing here was learned from."""
    return completed(notes(*smooth_drive(car, 601, seed=7)))


@pytest.fixture(scope="module")
def honest(car: CarParameters) -> GpWeights:
    return fit_weights(car, KINDS, count=300, seed=1)


@pytest.fixture(scope="module")
def gate(kinematic_artefact: Path, car: CarParameters) -> Gate:
    return Gate(GateSettings(), kinematic_artefact, car)


def incumbent(
    weights: GpWeights | None, number: int = 1, proven: bool = True, accepted_utc_ns: int = 2**62
) -> Incumbent:
    version = "" if weights is None else weights.version
    return Incumbent(number, version, weights, proven, accepted_utc_ns)


NOTHING = incumbent(None, 0)


# Checks --------------------------------------------------------------------------------------


def test_honest_weights_pass(
    gate: Gate, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    for weights, in_use in ((honest, None), (again, None), (honest, again), (again, honest)):
        verdict = gate.check(weights, [incumbent(in_use)], drive)
        assert verdict.accepted, verdict.text
        assert verdict.data["probation"] is False
        assert verdict.data["samples"] == 500
        for name in ("vx", "vy", "omega"):
            assert f"{name} " in verdict.text
            new, nominal = (verdict.data[f"error_{what}_{name}"] for what in ("new", "nominal"))
            assert float(new) < float(nominal)


@pytest.mark.parametrize("what", SPOILT)
def test_spoilt_weights_are_refused_in_favour_of_good_ones(
    gate: Gate, honest: GpWeights, again: GpWeights, drive: list[Sample], what: str
) -> None:
    verdict = gate.check(spoilt(again, what), [incumbent(honest)], drive)
    assert not verdict.accepted
    assert "worse than those in use" in verdict.text or "absurd" in verdict.text


@pytest.mark.parametrize("what", [name for name in SPOILT if not name.startswith("offset")])
def test_spoilt_weights_are_refused_in_favour_of_none(
    gate: Gate, honest: GpWeights, drive: list[Sample], what: str
) -> None:
    assert not gate.check(spoilt(honest, what), [NOTHING], drive).accepted


def test_good_weights_count_beside_those_in_use_that_may_be_bad(
    gate: Gate, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    """Bad weights on probation are no measure for others."""
    bad = spoilt(honest, "flip omega")
    on_probation = incumbent(bad, 2, proven=False)
    assert gate.check(spoilt(again, "flip omega"), [on_probation], drive).accepted
    assert not gate.check(
        spoilt(again, "flip omega"), [on_probation, incumbent(honest)], drive
    ).accepted


@pytest.mark.parametrize("count", [0, 49])
def test_with_few_samples_weights_are_accepted_on_probation(
    gate: Gate, honest: GpWeights, drive: list[Sample], count: int
) -> None:
    verdict = gate.check(spoilt(honest, "flip vy"), [NOTHING], drive[:count])
    assert verdict.accepted
    assert (verdict.data["samples"], verdict.data["probation"]) == (count, True)
    assert "on probation" in verdict.text


def test_stale_weights_are_refused(gate: Gate, honest: GpWeights, drive: list[Sample]) -> None:
    newer = incumbent(replace(honest, version="newer", created_utc_ns=2_000_000_000))
    for created, accepted in ((1_000_000_000, False), (2_000_000_000, True), (0, True)):
        weights = replace(honest, created_utc_ns=created)
        for samples in (drive, []):
            verdict = gate.check(weights, [newer], samples)
            assert verdict.accepted is accepted
            assert accepted or "stale: made 1 s before those in use, 'newer'" in verdict.text


def test_weights_dated_ahead_do_not_make_later_ones_stale(gate: Gate, honest: GpWeights) -> None:
    now_ns = time.time_ns()
    ahead = replace(honest, version="ahead", created_utc_ns=now_ns + 3000 * 10**9)
    assert gate.check(ahead, [NOTHING], []).accepted
    in_use = incumbent(ahead, accepted_utc_ns=now_ns)
    assert gate.check(replace(honest, created_utc_ns=now_ns + 10**9), [in_use], []).accepted
    assert not gate.check(replace(honest, created_utc_ns=now_ns - 10**9), [in_use], []).accepted


def test_weights_of_another_car_or_model_are_refused(gate: Gate, honest: GpWeights) -> None:
    other = replace(honest, car="rover")
    assert "those of the car 'rover'" in gate.check(other, [NOTHING], []).text
    other = replace(honest, discretisation="e_kinematic/rk4x1/0.05s/orca-0")
    verdict = gate.check(other, [NOTHING], [])
    assert (verdict.accepted, "were learned for" in verdict.text) == (False, True)


def test_weights_that_do_not_fit_are_refused(gate: Gate, honest: GpWeights) -> None:
    vx, vy, omega = honest.outputs
    large = replace(vx, inputs=np.zeros((1025, 6)), alpha=np.zeros(1025))
    verdict = gate.check(replace(honest, outputs=(large, vy, omega)), [NOTHING], [])
    assert (verdict.accepted, "1025 points" in verdict.text) == (False, True)


@pytest.mark.parametrize("factor", [30.0, 1e6, 1e300])
def test_absurd_weights_are_refused_without_any_sample(
    gate: Gate, honest: GpWeights, factor: float
) -> None:
    """1e300: finite numbers that overflow once scaled, or in the sum."""
    vx, vy, omega = honest.outputs
    huge: GpOutput = replace(omega, alpha=omega.alpha * factor)
    verdict = gate.check(replace(honest, outputs=(vx, vy, huge)), [NOTHING], [])
    assert not verdict.accepted
    assert "absurd" in verdict.text or "unusable" in verdict.text


def test_what_is_absurd_only_where_the_car_is_is_refused(
    gate: Gate, honest: GpWeights, drive: list[Sample], car: CarParameters
) -> None:
    """A spike too narrow for the states all over its range."""
    vx, vy, omega = honest.outputs
    sample = drive[-3]
    spike = np.r_[sample.x[3:7], sample.u]
    narrow = replace(vx, length_scales=np.full(6, 1e-3), inputs=spike[None], alpha=np.array([1e3]))
    weights = replace(honest, outputs=(narrow, vy, omega))
    assert gate.check(weights, [NOTHING], []).accepted
    verdict = gate.check(weights, [NOTHING], drive)
    assert (verdict.accepted, "absurd in its recent states" in verdict.text) == (False, True)


def test_plausible_states_are_within_the_cars_limits(car: CarParameters) -> None:
    samples = plausible_samples(car, STEP_S, 200)
    x, u = np.array([s.x for s in samples]), np.array([s.u for s in samples])
    assert np.abs(x[:, 6]).max() <= car.delta_max_rad
    assert car.d_min <= u[:, 0].min() < u[:, 0].max() <= car.d_max
    assert 2.0 < x[:, 3].max() < 6.0
    assert np.array([s.x for s in plausible_samples(car, STEP_S, 200)]).tobytes() == x.tobytes()


def test_an_error_that_is_not_finite_is_worse_than_anything() -> None:
    infinite, fine = np.full((20, 3), np.inf), np.ones((20, 3))
    slack = STEP_S * np.array(get_car("orca").tuning.gate.resolution)
    for old in (fine, infinite):
        assert compare(GateSettings(), slack, infinite, old, fine).worse == ("vx", "vy", "omega")
    assert compare(GateSettings(), slack, fine, fine, infinite).samples == 0


# Watch ---------------------------------------------------------------------------------------


def watched(gate: Gate, new: GpWeights, old: GpWeights | None, drive: list[Sample]) -> int | None:
    """Samples until the weights are given up; None if they are not."""
    watch = Watch(gate, incumbent(new, 2, proven=False), incumbent(old))
    for count, sample in enumerate(drive, 1):
        if watch.over:
            return None
        if watch.add(sample) is not None:
            return count
    raise AssertionError("the drive is too short")


def test_the_watch_keeps_honest_weights(
    gate: Gate, honest: GpWeights, again: GpWeights, drive: list[Sample]
) -> None:
    for new, old in ((honest, None), (again, None), (honest, again), (honest, honest)):
        assert watched(gate, new, old, drive) is None


@pytest.mark.parametrize("what", SPOILT)
def test_the_watch_gives_spoilt_weights_up(
    gate: Gate, honest: GpWeights, again: GpWeights, drive: list[Sample], what: str
) -> None:
    count = watched(gate, spoilt(again, what), honest, drive)
    assert count is not None
    assert 5 <= count <= LIMIT_SAMPLES


def test_the_watch_gives_up_what_leaves_no_solution(gate: Gate, honest: GpWeights) -> None:
    """A car that stands has no error by which it could be judged."""
    watch = Watch(gate, incumbent(honest, 2, proven=False), NOTHING)
    assert not any(watch.count(None) for _ in range(1000))
    assert [watch.count(True) for _ in range(25)] == [False] * 24 + [True]
    watch = Watch(gate, incumbent(honest, 2, proven=False), NOTHING)
    assert not any(watch.count(k % 2 == 0) for k in range(1000))


# Samples -------------------------------------------------------------------------------------


def test_faster_states_are_joined_to_samples_of_one_step(car: CarParameters) -> None:
    count, per_step = 40, 10
    states, inputs = smooth_drive(car, count + 1, seed=3)
    dense_x = np.repeat(states, per_step, axis=0)
    dense_u = np.repeat(inputs, per_step, axis=0)
    joined = completed(notes(dense_x, dense_u, STEP_S / per_step))
    direct = completed(notes(states, inputs))
    assert len(joined) == len(direct) == count
    for one, other in zip(joined, direct, strict=True):
        assert one.duration_s == other.duration_s == STEP_S
        assert one.x.tobytes() == other.x.tobytes()
        assert one.u == pytest.approx(other.u, abs=1e-12)


def test_gaps_standstill_and_repeated_states_make_no_sample(car: CarParameters) -> None:
    row = notes(*smooth_drive(car, 12, seed=3))
    lost = [*row[:4], *row[5:]]
    assert [s.number for s in completed(lost)] == [1, 2, 3, 6, 7, 8, 9, 10, 11]
    repeated = [*row[:5], row[4]._replace(seq=5)]
    assert len(completed(repeated)) == 4
    other_run = [*row[:5], *(one._replace(run=2) for one in row[5:])]
    assert len(completed(other_run)) == 10
    standing = [one._replace(x=(0.0, 0, 0, 0.04, 0, 0, 0)) for one in row]
    assert completed(standing) == []


# Shared memory -------------------------------------------------------------------------------


def a_state(seq: int) -> State:
    return State(
        seq, 0, 2**62 - 1, 3, 0.02 * seq, (float(seq),) * 7, (0.1, 0.2), 0, True, (), False
    )


@pytest.fixture
def memories() -> tuple[Memory, Memory]:
    """Both views of one memory."""
    writer = Memory(16)
    return writer, Memory(16, writer.fd)


def test_states_are_read_as_they_were_noted(memories: tuple[Memory, Memory]) -> None:
    writer, reader = memories
    for seq in range(5):
        writer.note(a_state(seq), None)
    found, after = reader.read(2)
    assert (after, reader.noted) == (5, 5)
    assert [one.number for one in found] == [2, 3, 4]
    newest = a_state(4)
    assert (found[-1].epoch, found[-1].run, found[-1].seq) == (newest.epoch, newest.run, newest.seq)
    assert (found[-1].x, found[-1].u_applied) == (newest.x, newest.u_applied)
    assert found[-1].lockstep
    for told in (None, False, True):
        writer.note(a_state(5), told)
        assert reader.read(reader.noted - 1)[0][0].fallen_back is told
    assert reader.read(8) == ([], 8)


def test_a_reader_far_behind_gets_what_is_still_there(memories: tuple[Memory, Memory]) -> None:
    writer, reader = memories
    for seq in range(20_000):
        writer.note(a_state(seq), None)
    found, after = reader.read(0)
    assert after == 20_000
    assert [one.seq for one in found] == list(range(20_000 - len(found), 20_000))
    assert 8000 < len(found) < 8192


def test_a_state_that_is_being_written_is_not_read(memories: tuple[Memory, Memory]) -> None:
    writer, reader = memories
    for seq in range(3):
        writer.note(a_state(seq), None)
    writer._map[64 + 128 + 50] ^= 1
    assert [one.seq for one in reader.read(0)[0]] == [0, 2]


def test_what_the_watch_has_seen_is_one_word(memories: tuple[Memory, Memory]) -> None:
    writer, reader = memories
    for told in ((0, False), (17, True), (ALL_SEEN, False)):
        reader.tell_watched(*told)
        assert writer.watched == told


def test_the_limits_hold_for_the_car_that_is_built_in() -> None:
    """Top speed by drive and drag: where the plausible states end."""
    from controller.gate.model import _top_speed_mps

    assert 3.0 < _top_speed_mps(get_car("orca")) < 5.0
