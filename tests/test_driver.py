"""The controller between a state and an input: stop and go, and each level of the fallback by a
real cause, with the compiled step."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PredictiveController
from bayesrace.controller.driver import (
    Decision,
    Driver,
    Level,
    Phase,
)
from bayesrace.controller.interface import Environment, StepOutput
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import CompensationSettings
from bayesrace.messages import State
from bayesrace.vehicles import default_car, get_car
from bayesrace.vehicles.models import dynamic
from tests import sample_messages as messages
from tests.conftest import SETTINGS, Circuit, discrete
from tests.cycle_rig import ScriptedLaw, scripted_driver, state

STEP_S = 0.02


class Rig:
    """A driver on the synthetic circuit, and the dynamic model as its plant."""

    def __init__(
        self,
        native: NativeStep,
        circuit: Circuit,
        hold: bool = False,
        delay_s: float = 0.0,
        sensor_tolerance: float = 1.0,
    ) -> None:
        """``sensor_tolerance`` 0: every state is believed."""
        self.controller = PredictiveController(native)
        car = get_car(native.manifest.car)
        settings = ControllerSettings(
            compensation=CompensationSettings(mode="fixed", delay_s=delay_s),
            hold=hold,
            sensor_tolerance=sensor_tolerance,
        )
        self.driver = Driver(self.controller, car, settings)
        self.plant = discrete(dynamic(car))
        self.x = circuit.start(v_mps=1.5)
        self.u = np.zeros(2)
        self.seq = 0
        self.epoch = 1
        self.environment: Environment | None = None

    def state(self, **changes: Any) -> State:
        values: dict[str, Any] = {
            "epoch": self.epoch, "time_s": self.seq * STEP_S, "x": tuple(self.x),
            "u_applied": tuple(self.u),
        }  # fmt: skip
        return messages.state(self.seq, **(values | changes))

    def cycle(self, late_s: float = 0.0, budget_s: float = 0.0, **changes: Any) -> Decision:
        """A state arrives, is answered, and the plant drives on."""
        received = self.state(**changes)
        self.driver.observe(received)
        budget_s = budget_s or 1e-9 * (late_s > 0)
        decision = self.driver.decide(received.time_s, budget_s, late_s, self.environment)
        self.advance(decision)
        return decision

    def silent_cycle(self) -> Decision:
        """No state arrives."""
        decision = self.driver.decide(self.seq * STEP_S)
        self.advance(decision)
        return decision

    def advance(self, decision: Decision) -> None:
        assert np.isfinite([decision.d, decision.delta_rate]).all()
        self.u = np.array([decision.d, decision.delta_rate])
        self.x = self.plant(self.x, self.u)
        self.seq += 1


@pytest.fixture
def rig(native: NativeStep, circuit: Circuit) -> Rig:
    return Rig(native, circuit)


def driving(rig: Rig, cycles: int = 20) -> Rig:
    for _ in range(cycles):
        assert rig.cycle().level is Level.SOLUTION
    assert rig.driver.phase is Phase.DRIVING
    return rig


def test_it_drives(rig: Rig) -> None:
    driving(rig, 100)
    assert rig.driver.levels == [100, 0, 0, 0]


def test_silence_goes_down_all_levels_and_ends_at_standstill(rig: Rig) -> None:
    """Stale state: predicted forward at first, then the plan, braking, standing."""
    driving(rig)
    bridged = [rig.silent_cycle().level for _ in range(3)]
    statuses = [rig.silent_cycle().status for _ in range(200)]
    assert set(statuses) == {Status.NO_STATE}
    counts = rig.driver.levels
    assert bridged == [Level.SOLUTION] * 3
    assert counts[Level.SHIFTED_PLAN] >= 2
    assert counts[Level.BRAKE] > 10
    assert counts[Level.STOP] > 10
    assert rig.driver.phase is Phase.FALLBACK
    # by dead reckoning alone it has neither gone on nor been driven backwards
    assert abs(rig.x[3]) < 0.15


def test_states_that_come_back_drive_again_after_several_good_solutions(rig: Rig) -> None:
    driving(rig)
    for _ in range(12):
        rig.silent_cycle()
    levels = [rig.cycle().level for _ in range(4)]
    assert levels == [Level.BRAKE, Level.BRAKE, Level.SOLUTION, Level.SOLUTION]


@pytest.mark.parametrize(
    ("delay_s", "index", "number", "status"),
    [
        # Steered farther than a period at full rate can bring back within the limit.
        (0.0, 6, 0.6, Status.INFEASIBLE),
        (0.0, 4, np.nan, Status.BAD_STATE),
        # With a delay to predict over, the model is asked before the step is.
        (0.02, 4, np.nan, Status.UNPREDICTABLE),
        (0.02, 4, 1e5, Status.UNPREDICTABLE),
    ],
)
def test_a_state_without_a_solution_is_answered_by_the_plan_before(
    native: NativeStep, circuit: Circuit, delay_s: float, index: int, number: float, status: int
) -> None:
    rig = driving(Rig(native, circuit, delay_s=delay_s, sensor_tolerance=0))
    x = rig.x.copy()
    x[index] = number
    decision = rig.cycle(x=tuple(x))
    assert (decision.status, decision.level) == (status, Level.SHIFTED_PLAN)
    rig.driver.rehearse()
    if index != 6:
        assert rig.cycle().level is Level.SOLUTION
    rig.cycle(x=tuple(x))
    for _ in range(20):
        rig.silent_cycle()
    assert rig.driver.phase is Phase.FALLBACK


def test_a_budget_too_small_for_a_plan_steps_down(rig: Rig, native: NativeStep) -> None:
    """The first step of a drive is cold: one iteration, which is always done, is not enough."""
    strict = SETTINGS.model_copy(update={"defect_max": 1e-9})
    native.set_parameters(get_car(native.manifest.car), strict)
    decision = rig.cycle(budget_s=1e-9)
    assert decision.status == Status.TIME_LIMIT
    assert decision.level is Level.BRAKE


def test_a_late_solution_is_driven_from_where_it_has_got_to(rig: Rig) -> None:
    driving(rig)
    decision = rig.cycle(late_s=2.5 * STEP_S)
    output = rig.driver.output
    assert output is not None
    assert decision.level is Level.SHIFTED_PLAN
    assert (decision.d, decision.delta_rate) == pytest.approx(tuple(output.plan_u[2]))


def test_a_step_that_raises_is_counted_and_stepped_down_from(kinematic_artefact: Path) -> None:
    plan = np.full((20, 2), 0.25)
    law = ScriptedLaw(lambda _: StepOutput(u=plan[0], plan_u=plan))
    driver = scripted_driver(kinematic_artefact, law)
    for seq in range(3):
        driver.observe(state(seq))
        assert driver.decide(seq * STEP_S).level is Level.SOLUTION
    law.answer = None
    driver.observe(state(3))
    decision = driver.decide(3 * STEP_S)
    assert (decision.status, decision.level) == (Status.STEP_FAILED, Level.SHIFTED_PLAN)
    assert (driver.count("failed"), driver.output) == (1, None)
    assert driver.last_error == "RuntimeError: no step today"


def test_stop_and_go(rig: Rig) -> None:
    driving(rig)
    rig.driver.stop()
    slowing = 0
    while rig.cycle().status != Status.HALTED:
        assert rig.driver.phase is Phase.STOPPED
        slowing += 1
        assert slowing < 200
    for _ in range(20):
        assert rig.cycle().status == Status.HALTED
    assert abs(rig.x[3]) < 0.05
    assert rig.driver.levels == [20 + slowing, 0, 0, 0]  # a stop on command is no fallback
    rig.driver.go()
    for _ in range(60):
        assert rig.cycle().level is Level.SOLUTION
    assert rig.x[3] > 0.5


@pytest.mark.parametrize("change", [{"run": 2}, {"epoch": 2}])
def test_a_stopped_car_stays_stopped_in_the_next_run(rig: Rig, change: dict[str, int]) -> None:
    """Plant time begins anew there: by the old one the speed allowed would be beyond all bounds."""
    driving(rig, 60)
    rig.driver.stop()
    while rig.cycle().status != Status.HALTED:
        pass
    rig.driver.lost(silent=False)
    rig.seq, rig.epoch = 0, change.get("epoch", 1)
    rig.seq += 1000 * (rig.epoch == 1)
    for _ in range(50):
        decision = rig.cycle(
            run=change.get("run", 1), time_s=0.02 * rig.seq - 20 * (rig.epoch == 1)
        )
        assert decision.status == Status.HALTED
        assert abs(decision.d) < 0.02
    assert rig.driver.phase is Phase.STOPPED


def test_a_rolling_car_taken_over_on_hold_slows_down_along_the_line(
    native: NativeStep, circuit: Circuit
) -> None:
    rig = Rig(native, circuit, hold=True)
    count = 0
    while rig.cycle().status != Status.HALTED:
        count += 1
        assert count < 200
    assert count > 10
    assert abs(rig.x[3]) < 0.15
    assert rig.driver.phase is Phase.READY


def test_on_hold_it_stands_until_go(native: NativeStep, circuit: Circuit) -> None:
    rig = Rig(native, circuit, hold=True)
    rig.x[3] = 0.0
    for _ in range(10):
        assert rig.cycle().status == Status.HALTED
    assert rig.driver.phase is Phase.READY
    assert abs(rig.x[3]) < 1e-3
    rig.driver.go()
    assert rig.cycle().level is Level.SOLUTION


def test_another_plant_begins_anew_and_its_forerunner_is_not_heard(rig: Rig) -> None:
    driving(rig)
    left_over = rig.state()
    rig.driver.lost(silent=False)
    rig.epoch, rig.seq = 2, 0
    assert rig.cycle().level is Level.SOLUTION
    assert not rig.driver.observe(left_over)
    assert rig.driver.count("foreign") == 1
    assert rig.cycle().level is Level.SOLUTION


@pytest.mark.parametrize(
    ("broken", "text"),
    [
        ({"step": lambda *_: 1 / 0}, "ZeroDivisionError"),
        ({"step": lambda *_: StepOutput(u=np.zeros(2), status=253)}, "status 253 is not from 0"),
        ({"reset": lambda: [][0]}, "IndexError"),
        ({"predict": lambda *_: np.zeros(71)}, "ValueError"),
    ],
    ids=["step", "status", "reset", "predict"],
)
def test_whatever_a_law_in_python_does_ends_in_the_fallback(
    kinematic_artefact: Path, monkeypatch: pytest.MonkeyPatch, broken: dict[str, Any], text: str
) -> None:
    law = ScriptedLaw(lambda _: StepOutput(u=np.zeros(2)))
    for name, function in broken.items():
        monkeypatch.setattr(law, name, function)
    driver = scripted_driver(
        kinematic_artefact, law, compensation=CompensationSettings(mode="fixed", delay_s=0.02)
    )
    driver.observe(state(0))
    decision = driver.decide(0.0)
    assert decision.status == (Status.UNPREDICTABLE if "predict" in broken else Status.STEP_FAILED)
    assert decision.level is Level.STOP
    assert text in driver.controller.last_error


def test_an_interrupt_in_a_law_is_not_lost(kinematic_artefact: Path) -> None:
    def interrupted(_: Floats) -> StepOutput:
        raise KeyboardInterrupt

    driver = scripted_driver(kinematic_artefact, ScriptedLaw(interrupted))
    driver.observe(state(0))
    with pytest.raises(KeyboardInterrupt):
        driver.decide(0.0)


def test_two_cycles_of_one_controller_tell_their_own_results(
    native: NativeStep, circuit: Circuit
) -> None:
    first = Rig(native, circuit)
    first.cycle()
    cost = first.driver.output.cost  # type: ignore[union-attr]
    second = Rig(native, circuit)
    second.x[3] = 0.3
    second.cycle()
    assert second.driver.output.cost != cost  # type: ignore[union-attr]
    del second
    gc.collect()
    assert first.cycle().level is Level.SOLUTION


def test_a_refused_step_has_a_reason(native: NativeStep, circuit: Circuit) -> None:
    rig = Rig(native, circuit)
    rig.environment = Environment(speed_limit_mps=-1.0)
    assert rig.cycle().status == Status.STEP_FAILED
    assert rig.driver.last_error == "a parameter is not finite or out of its range"


def test_a_stop_and_a_speed_limit_hold_together(kinematic_artefact: Path) -> None:
    """The lower speed, and of the rates by which both fall along the horizon, the higher."""
    seen: list[Environment] = []

    class Law(ScriptedLaw):
        def step(self, x: Any, u: Any, environment: Environment, *others: float) -> StepOutput:
            seen.append(environment)
            return super().step(x, u, environment, *others)

    law = Law(lambda _: StepOutput(u=np.zeros(2)))
    driver = scripted_driver(kinematic_artefact, law)
    moving = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    driver.observe(state(0, x=moving))
    driver.decide(0.0, environment=Environment(2.0, 0.5))
    driver.stop()
    for seq, environment in enumerate((Environment(2.0, 5.0), Environment(0.4, 0.5)), 1):
        driver.observe(state(seq, x=moving))
        driver.decide(seq * STEP_S, environment=environment)
    stop_mps2 = default_car().tuning.driving.stop_mps2
    assert seen[0] == (2.0, 0.5)
    assert seen[1] == (1.0, 5.0)
    assert seen[2] == (0.4, stop_mps2)


def test_second_starts_and_jumps_of_the_cost_are_counted(kinematic_artefact: Path) -> None:
    output = StepOutput(u=np.zeros(2), second_start=1, cost_shifted=1.0, cost=100.0)
    driver = scripted_driver(kinematic_artefact, ScriptedLaw(lambda _: output))
    driver.observe(state(0))
    driver.decide(0.0)
    assert (driver.count("second_starts"), driver.count("cost_jumps")) == (1, 1)
