"""With an exact model, the predicted state is the true one at the moment the input acts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesrace.messages import State
from bayesrace.transport import Numbering
from controller.compensation import CompensationSettings, DelayCompensator
from controller.states import StateStream

Floats = NDArray[np.float64]

STEP_S = 0.02


def exact(x: Floats, u: Floats, duration_s: float) -> Floats:
    """A car on a line: speed goes to 3 d with a time constant; steering integrates its rate."""
    after = x.copy()
    decay = np.exp(-duration_s / 0.3)
    after[0] += 3 * u[0] * duration_s + (x[3] - 3 * u[0]) * 0.3 * (1 - decay)
    after[3] = 3 * u[0] + (x[3] - 3 * u[0]) * decay
    after[6] += duration_s * u[1]
    return after


def state(seq: int, x: Floats, u: Floats, **changes: Any) -> State:
    values: dict[str, Any] = {
        "source_time_ns": 0, "epoch": 1, "run": 1, "time_s": seq * STEP_S, "lap": 0,
        "lockstep": False, "answers": (), "final": False,
    }  # fmt: skip
    return State(seq=seq, x=tuple(x), u_applied=tuple(u), **(values | changes))


class Delayed:
    """A plant whose inputs act ``delay_s`` after the plant time on which they were made."""

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.x, self.u, self.time_s = np.zeros(7), np.zeros(2), 0.0
        self.coming: list[tuple[float, Floats]] = []

    def accept(self, basis_s: float, u: Floats) -> None:
        self.coming.append((basis_s + self.delay_s, u))

    def advance(self, until_s: float) -> None:
        while self.coming and self.coming[0][0] <= until_s:
            acts_s, u = self.coming.pop(0)
            self.x, self.time_s = exact(self.x, self.u, acts_s - self.time_s), acts_s
            self.u = u
        self.x, self.time_s = exact(self.x, self.u, until_s - self.time_s), until_s


def drive(delay_s: float, settings: CompensationSettings, every: int = 1) -> list[float]:
    """Drives with random inputs; how far each prediction was off. ``every`` state arrives."""
    random = np.random.default_rng(2)
    plant, compensator = Delayed(delay_s), DelayCompensator(settings, exact)
    promised: list[tuple[float, Floats]] = []
    newest = state(0, plant.x, plant.u)
    for k in range(60):
        plant.advance(k * STEP_S)
        answers = (float(k), delay_s, delay_s) if k else ()
        if k % every == 0:
            newest = state(k, plant.x, plant.u, answers=answers)
            compensator.observe(newest)
        basis_s = k * STEP_S
        x, _ = compensator.at_acting(newest, basis_s)
        promised.append((basis_s + delay_s, x.copy()))
        u = random.uniform([-0.1, -5.0], [1.0, 5.0])
        compensator.sent(basis_s, *u)
        plant.accept(basis_s, u)
    truth = Delayed(delay_s)
    truth.coming = [(0.0, np.zeros(2))]
    random = np.random.default_rng(2)
    errors = []
    for k, (acts_s, x) in enumerate(promised):
        truth.advance(acts_s)
        errors.append(float(np.abs(truth.x - x).max()))
        truth.u = random.uniform([-0.1, -5.0], [1.0, 5.0])
        assert k * STEP_S + delay_s == pytest.approx(acts_s)
    return errors


@pytest.mark.parametrize("delay_s", [0.001, 0.02, 0.03, 0.08, 0.16])
def test_the_measured_delay_is_covered(delay_s: float) -> None:
    errors = drive(delay_s, CompensationSettings())
    assert max(errors[2:]) < 1e-9  # the first state comes before anything is measured


def test_a_fixed_delay_needs_no_measurement() -> None:
    assert max(drive(0.05, CompensationSettings(mode="fixed", delay_s=0.05))) < 1e-9


def test_lost_states_are_bridged() -> None:
    assert max(drive(0.03, CompensationSettings(), every=3)[2:]) < 1e-9


def test_without_compensation_the_state_is_that_of_the_past() -> None:
    assert max(drive(0.08, CompensationSettings(mode="off"))) > 0.01


def test_the_delay_is_the_median_and_overtaken_answers_do_not_count() -> None:
    compensator = DelayCompensator(CompensationSettings(), exact)
    for seq, acting_s in enumerate([0.02, 0.02, 0.5, 0.02, -1.0, 0.03, 0.03]):
        compensator.observe(state(seq, np.zeros(7), np.zeros(2), answers=(0.0, 0.01, acting_s)))
    assert compensator.delay_s == 0.02


def test_no_prediction_goes_farther_than_its_limit() -> None:
    compensator = DelayCompensator(CompensationSettings(mode="fixed", delay_s=1.0), exact)
    moving = np.zeros(7)
    moving[3] = 1.0
    x, _ = compensator.at_acting(state(0, moving, np.zeros(2)), 5.0)
    assert x == pytest.approx(exact(moving, np.zeros(2), 0.5))


def test_a_run_goes_on_with_rising_numbers_and_another_plant_begins_anew() -> None:
    stream = StateStream()
    zero = np.zeros(7), np.zeros(2)
    for seq in (100, 101, 104, 103, 104):
        stream.accept(state(seq, *zero))
    # 102 is lost; 103 was overtaken, the second 104 a copy
    assert (stream.received, stream.stale) == (5, 2)
    assert stream.newest is not None
    assert stream.newest.seq == 104
    stream.end()
    assert stream.accept(state(0, *zero, epoch=2))
    assert not stream.accept(state(105, *zero, epoch=1))
    assert stream.accept(state(1, *zero, epoch=2))
    assert stream.newest.epoch == 2
    assert (stream.stale, stream.foreign) == (2, 1)
    assert stream.interval_s == pytest.approx(STEP_S)


@pytest.mark.parametrize(
    "odd",
    [{"seq": 1100}, {"seq": 2**63 - 1}, {"epoch": 2}, {"run": 2}, {"seq": 0}],
    ids=["ahead", "far ahead", "epoch", "run", "behind"],
)
def test_one_foreign_state_is_counted_and_nothing_else(odd: dict[str, Any]) -> None:
    stream = StateStream()
    zero = np.zeros(7), np.zeros(2)
    assert stream.accept(state(100, *zero))
    assert not stream.accept(replace(state(101, *zero), **odd))
    assert stream.stale + stream.foreign == 1
    assert stream.accept(state(101, *zero))
    assert stream.accept(state(102, *zero))
    assert (stream.lost, stream.stale + stream.foreign) == (0, 1)


def test_a_gap_of_a_quarter_second_is_a_loss_at_any_rate() -> None:
    zero = np.zeros(7), np.zeros(2)
    fast = [replace(state(seq, *zero), time_s=seq * 0.002) for seq in (100, 101, 226, 527)]
    stream = StateStream()
    assert [stream.accept(one) for one in fast] == [True, True, True, False]
    assert (stream.lost, stream.foreign) == (124, 1)


@pytest.mark.parametrize("left", [{"seq": 101}, {"epoch": 2, "seq": 0}, {"seq": 40}])
def test_several_in_a_row_are_followed_at_once_and_anything_after_silence(
    left: dict[str, Any],
) -> None:
    """What is taken for the run's newest state may have been the foreign one."""
    zero = np.zeros(7), np.zeros(2)
    for silence in (False, True):
        stream = StateStream()
        stream.accept(state(100, *zero))
        assert stream.accept(state(110, *zero))  # lost nine, or was deceived
        first = replace(state(0, *zero), lockstep=silence, **left)
        if silence:
            assert not stream.accept(first)
            assert stream.forget() == first
            assert stream.forget() is None
            assert stream.accept(first)
        else:
            row = [replace(first, seq=first.seq + k) for k in range(5)]
            assert [stream.accept(one) for one in row] == [False, False, False, True, True]


def test_two_plants_at_once_are_not_mixed() -> None:
    stream = StateStream()
    zero = np.zeros(7), np.zeros(2)
    for seq in range(50):
        assert stream.accept(state(seq, *zero, epoch=1))
        assert not stream.accept(state(seq, *zero, epoch=2))
    assert stream.foreign == 50


def test_losses_are_told_also_when_the_first_message_of_a_restarted_sender_is_lost() -> None:
    numbering = Numbering()
    for seq in (0, 1, 2, 5000, 5001, 3, 4, 6):
        numbering.note(seq)
    assert (numbering.received, numbering.lost) == (8, 4997 + 1)
    odd = Numbering()
    for seq in (0, 1, 2**63 - 1, 2, 3):
        odd.note(seq)
    assert (odd.received, odd.lost) == (5, 0)
    overtaken = Numbering()
    for seq in (0, 1, 3, 2, 4):
        overtaken.note(seq)
    assert (overtaken.received, overtaken.lost) == (5, 0)
