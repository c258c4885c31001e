"""With an exact model, the predicted state is the true one at the moment the input acts; and which
states are driven on. Both are C, driven here by the control cycle's binding."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.arrays import Floats
from bayesrace.controller.driver import Driver
from bayesrace.controller.interface import StepOutput
from bayesrace.controller.settings import CompensationSettings
from bayesrace.messages import Numbering, State
from bayesrace.operation.host import HostProgram
from tests.cycle_rig import STEP_S, ScriptedLaw, scripted_driver, state
from tests.exchanged import racing_host

__all__ = ["racing_host"]  # a fixture


def exact(x: Floats, u: Floats, duration_s: float) -> Floats:
    """A car on a line: speed goes to 3 d with a time constant; steering integrates its rate."""
    after = x.copy()
    decay = np.exp(-duration_s / 0.3)
    after[0] += 3 * u[0] * duration_s + (x[3] - 3 * u[0]) * 0.3 * (1 - decay)
    after[3] = 3 * u[0] + (x[3] - 3 * u[0]) * decay
    after[6] += duration_s * u[1]
    return after


class Delayed:
    """A plant whose inputs act ``delay_s`` after the plant time on which they were made."""

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.x, self.u, self.time_s = np.zeros(7), np.zeros(2), 0.0
        self.coming: list[tuple[float, Floats]] = []
        self.begun: list[tuple[float, Floats]] = []
        """When each input began to act, and the state then."""

    def accept(self, decided_at_s: float, u: Floats) -> None:
        self.coming.append((decided_at_s + self.delay_s, u))

    def advance(self, until_s: float) -> None:
        while self.coming and self.coming[0][0] <= until_s:
            acts_s, u = self.coming.pop(0)
            self.x, self.time_s = exact(self.x, self.u, acts_s - self.time_s), acts_s
            self.u = u
            self.begun.append((acts_s, self.x))
        self.x, self.time_s = exact(self.x, self.u, until_s - self.time_s), until_s


def drive(
    artefact: Path, delay_s: float, settings: CompensationSettings, every: int = 1
) -> list[float]:
    """Drives with random inputs; how far each prediction was off. ``every`` state arrives."""
    random = np.random.default_rng(2)
    seen: list[Floats] = []

    def answer(x: Floats) -> StepOutput:
        seen.append(x)
        return StepOutput(u=random.uniform([-0.1, -5.0], [1.0, 5.0]))

    driver = scripted_driver(artefact, ScriptedLaw(answer, exact), compensation=settings)
    plant = Delayed(delay_s)
    for k in range(60):
        plant.advance(k * STEP_S)
        delays = (float(k), delay_s, delay_s) if k else ()
        if k % every == 0:
            assert driver.observe(
                state(k, x=tuple(plant.x), u_applied=tuple(plant.u), actuation_delays=delays)
            )
        decision = driver.decide(k * STEP_S)
        plant.accept(k * STEP_S, np.array([decision.d, decision.delta_rate]))
    plant.advance(60 * STEP_S + delay_s)
    assert [acts_s for acts_s, _ in plant.begun] == pytest.approx(STEP_S * np.arange(60) + delay_s)
    return [
        float(np.abs(x - predicted).max())
        for (_, x), predicted in zip(plant.begun, seen, strict=True)
    ]


@pytest.mark.parametrize("delay_s", [0.001, 0.02, 0.03, 0.08, 0.16])
def test_the_measured_delay_is_covered(kinematic_artefact: Path, delay_s: float) -> None:
    errors = drive(kinematic_artefact, delay_s, CompensationSettings())
    assert max(errors[2:]) < 1e-9  # the first state comes before anything is measured


def test_a_fixed_delay_needs_no_measurement(kinematic_artefact: Path) -> None:
    settings = CompensationSettings(mode="fixed", delay_s=0.05)
    assert max(drive(kinematic_artefact, 0.05, settings)) < 1e-9


def test_lost_states_are_bridged(kinematic_artefact: Path) -> None:
    assert max(drive(kinematic_artefact, 0.03, CompensationSettings(), every=3)[2:]) < 1e-9


def test_without_compensation_the_state_is_that_of_the_past(kinematic_artefact: Path) -> None:
    assert max(drive(kinematic_artefact, 0.08, CompensationSettings(mode="off"))) > 0.01


@pytest.fixture(name="driver")
def drivers(kinematic_artefact: Path) -> Callable[..., Driver]:
    """Makes one for a law that stands still."""

    def make(answer: Any = None, **chosen: Any) -> Driver:
        law = ScriptedLaw(answer or (lambda _: StepOutput(u=np.zeros(2))), exact)
        return scripted_driver(kinematic_artefact, law, compensation=CompensationSettings(**chosen))

    return make


Make = Callable[..., Driver]


def test_the_delay_is_the_median_and_overtaken_answers_do_not_count(driver: Make) -> None:
    made = driver()
    for seq, acting_s in enumerate([0.02, 0.02, 0.5, 0.02, -1.0, 0.03, 0.03]):
        made.observe(state(seq, actuation_delays=(0.0, 0.01, acting_s)))
    assert made.delay_s == 0.02


def test_no_prediction_goes_farther_than_its_limit(driver: Make) -> None:
    seen: list[Floats] = []

    def answer(x: Floats) -> StepOutput:
        seen.append(x)
        return StepOutput(u=np.zeros(2))

    made = driver(answer, mode="fixed", delay_s=1.0)
    moving = np.zeros(7)
    moving[3] = 1.0
    made.observe(state(0, x=tuple(moving)))
    made.decide(5.0)
    assert seen[0] == pytest.approx(exact(moving, np.zeros(2), 0.5))


def test_a_run_goes_on_with_rising_numbers_and_another_plant_begins_anew(driver: Make) -> None:
    made = driver()
    for seq in (100, 101, 104, 103, 104):
        made.observe(state(seq))
    # 102 is lost; 103 was overtaken, the second 104 a copy
    assert (made.numbering.received, made.count("stale")) == (5, 2)
    assert made.newest == state(104)
    made.lost(silent=False)
    assert made.observe(state(0, epoch=2))
    assert not made.observe(state(105, epoch=1))
    assert made.observe(state(1, epoch=2))
    assert made.newest == state(1, epoch=2)
    assert (made.count("stale"), made.count("foreign")) == (2, 1)
    assert made.interval_s == pytest.approx(STEP_S)


ODD: dict[str, dict[str, Any]] = {
    "ahead": {"seq": 1100}, "far ahead": {"seq": 2**63 - 1}, "epoch": {"epoch": 2},
    "run": {"run": 2}, "behind": {"seq": 0},
}  # fmt: skip


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_one_foreign_state_is_counted_and_nothing_else(driver: Make, odd: dict[str, Any]) -> None:
    made = driver()
    assert made.observe(state(100))
    assert not made.observe(state(**({"seq": 101} | odd)))
    assert made.count("stale") + made.count("foreign") == 1
    assert made.observe(state(101))
    assert made.observe(state(102))
    assert (made.numbering.lost, made.count("stale") + made.count("foreign")) == (0, 1)


def test_a_gap_of_a_quarter_second_is_a_loss_at_any_rate(driver: Make) -> None:
    made = driver()
    fast = [state(seq, time_s=seq * 0.002) for seq in (100, 101, 226, 527)]
    assert [made.observe(one) for one in fast] == [True, True, True, False]
    assert (made.numbering.lost, made.count("foreign")) == (124, 1)


@pytest.mark.parametrize("left", [{"seq": 101}, {"epoch": 2, "seq": 0}, {"seq": 40}])
def test_several_in_a_row_are_followed_at_once_and_anything_after_silence(
    driver: Make, left: dict[str, Any]
) -> None:
    """What is taken for the run's newest state may have been the foreign one."""
    for silence in (False, True):
        made = driver()
        made.observe(state(100))
        assert made.observe(state(110))  # lost nine, or was deceived
        row = [state(lockstep=silence, **(left | {"seq": left["seq"] + k})) for k in range(5)]
        if silence:
            assert not made.observe(row[0])
            assert made.lost(silent=True) == row[0]
            assert made.lost(silent=True) is None
            assert made.observe(row[0])
        else:
            assert [made.observe(one) for one in row] == [False, False, False, True, True]


def test_two_plants_at_once_are_not_mixed(driver: Make) -> None:
    made = driver()
    for seq in range(50):
        assert made.observe(state(seq, epoch=1))
        assert not made.observe(state(seq, epoch=2))
    assert made.count("foreign") == 50


def test_the_controller_without_python_drives_on_the_same_states(
    driver: Make, racing_host: HostProgram, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the tests above: it answers them, and no others."""
    observed: dict[Driver, list[tuple[State, bool]]] = {}
    observe = Driver.observe

    def observing(made: Driver, one: State) -> bool:
        observed.setdefault(made, []).append((one, observe(made, one)))
        return observed[made][-1][1]

    monkeypatch.setattr(Driver, "observe", observing)
    for odd in ODD.values():
        test_one_foreign_state_is_counted_and_nothing_else(driver, odd)
    test_a_gap_of_a_quarter_second_is_a_loss_at_any_rate(driver)
    test_two_plants_at_once_are_not_mixed(driver)
    for states in observed.values():
        answers = racing_host.answers(replace(one, lockstep=True) for one, _ in states)
        expected = [(one.epoch, one.run, one.seq) for one, new in states if new]
        assert [(one.epoch, one.run, one.state_seq) for one, _ in answers] == expected
    assert len(observed) == len(ODD) + 2


def test_losses_are_counted_also_when_the_first_message_of_a_restarted_sender_is_lost() -> None:
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


def test_a_shadow_predicts_by_the_inputs_of_the_controller_that_drives(
    kinematic_artefact: Path,
) -> None:
    """Both are shown the same state, in which the input to come will act; alone it would not be."""
    delay = CompensationSettings(mode="fixed", delay_s=3.5 * STEP_S)
    seen: dict[str, list[Floats]] = {"driving": [], "shadow": [], "alone": []}

    def driver(name: str, u: tuple[float, float]) -> Driver:
        def answer(x: Floats) -> StepOutput:
            seen[name].append(x.copy())
            return StepOutput(u=np.array(u))

        law = ScriptedLaw(answer, exact)
        return scripted_driver(kinematic_artefact, law, compensation=delay)

    driving, shadow, alone = driver("driving", (0.8, 1.0)), *(
        driver(name, (0.1, -2.0)) for name in ("shadow", "alone")
    )  # fmt: skip
    for seq in range(10):
        moment = state(seq, x=(0.1 * seq, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0), u_applied=(0.8, 1.0))
        for one in (driving, shadow, alone):
            assert one.observe(moment)
            one.decide(moment.time_s)
        sent = driving.decision
        shadow.sent(sent.decided_at_s, (sent.d, sent.delta_rate))
    assert np.array_equal(seen["shadow"], seen["driving"])
    assert np.abs(np.subtract(seen["alone"], seen["driving"])).max() > 0.05
