"""The controller as an FMU in a plain FMI master: the lap of the lockstep run, no bad input."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from bayesrace.arrays import Floats
from bayesrace.codegen.fmu import pack
from bayesrace.controller.driver import Level
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.messages import Reading
from bayesrace.sensors import Sensors
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import STATES
from tests.car_fmu import packed_car
from tests.fmu_lockstep import (  # noqa: F401 - a fixture is used by name
    RACING,
    STEP_S,
    STEPS,
    Exported,
    Lockstep,
    answers,
    exported_controllers,
    same,
    strewn,
    versions,
)
from tests.fmu_master import Slave, drive
from tests.instruments import mocap, odometry


@versions
def test_fmpy_has_no_finding(exported: Exported, version: Literal[2, 3]) -> None:
    assert validate_fmu(str(exported.fmu(version))) == []


@versions
def test_a_plain_master_drives_the_lockstep_run(exported: Exported, version: Literal[2, 3]) -> None:
    """The controller gives the same bits; the car differs by rounding."""
    start = exported.circuit.start(v_mps=0.1)
    run = exported.lockstep().run(start, STEPS)
    laps = (run.x[-1][2] - run.x[0][2]) / (2 * np.pi)
    assert laps > 3
    controller = exported.slave(exported.fmu(version))
    same(answers(controller, run.x), run)
    controller.reset()
    controller.initialise()
    car = exported.slave(packed_car(version), dict(zip(STATES, start, strict=True)))
    states, inputs = drive(car, controller, STEPS)
    np.testing.assert_allclose(states, run.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(inputs, run.u, rtol=0, atol=1e-7)
    controller.close()
    car.close()


def test_a_master_that_steps_side_by_side_is_compensated_for(exported: Exported) -> None:
    """The car gets each input a step later, and the controller knows."""
    start = exported.circuit.start(v_mps=0.1)
    run = exported.lockstep(delay_s=STEP_S).run(start, STEPS)
    controller = exported.slave(exported.fmu(3), {"delay": STEP_S})
    same(answers(controller, run.x), run)
    assert max(level for _, level in run.said) == Level.SOLUTION
    controller.reset()
    controller.initialise({"delay": STEP_S})
    car = exported.slave(packed_car(3), dict(zip(STATES, start, strict=True)))
    states, _ = drive(car, controller, STEPS, parallel=True)
    np.testing.assert_allclose(states, run.x, rtol=0, atol=1e-7)


@pytest.mark.parametrize("turned_rad", [0.0, 2.0])
def test_a_car_that_is_held_is_answered_as_in_lockstep(
    exported: Exported, turned_rad: float
) -> None:
    """By something, whatever is sent; on its line, and about to turn round."""
    held = exported.circuit.start(0.5, 0.0)
    held[2] += turned_rad
    run = exported.lockstep()
    for k in range(80):
        d, delta_rate = run.answer(k, held)
        run.plant.u_applied = (float(d), float(delta_rate))
    same(answers(exported.slave(exported.fmu(3)), run.x), run)


def test_inputs_on_their_way_and_states_that_nothing_follows_from_are_compensated_for_alike(
    exported: Exported,
) -> None:
    """A delay of two and a half periods; a state that is no state cannot be predicted from."""
    run = exported.lockstep(delay_s=2.5 * STEP_S, tolerance=0.0)
    for k, x in enumerate(
        exported.lockstep().run(exported.circuit.start(v_mps=1.0), 120, strewn).x
    ):
        d, delta_rate = run.u[k - 3] if k >= 3 else (0.0, 0.0)
        run.plant.u_applied = (float(d), float(delta_rate))
        run.answer(k, x)
    assert {status for status, _ in run.said} >= {Status.CONVERGED, Status.UNPREDICTABLE}
    controller = exported.slave(exported.fmu(3), {"delay": 2.5 * STEP_S, "sensor_tolerance": 0.0})
    same(answers(controller, run.x), run, tolerance=1e-10)  # a master's time is a sum


@versions
def test_bad_states_are_answered_as_in_lockstep_and_nothing_bad_comes_out(
    exported: Exported, version: Literal[2, 3]
) -> None:
    run = exported.lockstep(tolerance=0.0).run(exported.circuit.start(v_mps=1.0), 320, strewn)
    statuses, levels = ({said[i] for said in run.said} for i in (0, 1))
    assert statuses >= {0, Status.INFEASIBLE, Status.BAD_STATE}
    assert levels == set(Level)
    controller = exported.slave(exported.fmu(version), {"sensor_tolerance": 0.0})
    same(answers(controller, run.x), run)
    controller.reset()
    controller.initialise({"d_applied_connected": 1.0, "delay": 0.03, "sensor_tolerance": 0.0})
    outputs = [v.name for v in controller.description.modelVariables if v.causality == "output"]
    limits = np.array([get_car("orca").d_max, get_car("orca").delta_rate_max_radps])
    poison, unplanned = (np.nan, np.inf, -np.inf, -1.0, 1e300), 0
    for k, x in enumerate(run.x):
        inputs = dict(zip(STATES, x, strict=True))
        names = ("d_applied", "speed_limit", "speed_limit_rate")
        inputs[names[k % 3]] = poison[k // 3 % 5] if k % 4 else 0.5
        controller.set(inputs)
        controller.step(STEP_S)
        assert np.isfinite(controller.get(*outputs)).all()
        assert (np.abs(controller.get("d", "delta_rate")) <= limits).all()
        status, tube_m, pace = controller.get("status", "tube_m", "pace")
        assert pace > 0
        if status == Status.BAD_STATE or status >= Status.DOUBTED:  # nothing was planned
            unplanned += 1
            assert tube_m == -1
    assert unplanned > 0
    assert controller.messages == []


def test_a_sensor_that_freezes_stops_the_car_on_its_line(exported: Exported) -> None:
    run = exported.lockstep().run(exported.circuit.start(v_mps=1.0), 60)
    controller = exported.slave(exported.fmu(3))
    said = answers(controller, [*run.x, *[run.x[-1]] * 20])[61:]
    assert (said[3:, 2] == Status.DOUBTED).all()
    assert (said[-10:, 3] >= Level.BRAKE).all()


def test_parameters_act_and_limits_can_be_tuned_during_the_run(exported: Exported) -> None:
    start = exported.circuit.start(v_mps=0.1)
    run = exported.lockstep()
    other = RACING.model_copy(update={"r_duty": 0.05, "margin_m": 0.03})
    run.native.set_parameters(run.car, other)
    run.run(start, 100)
    controller = exported.slave(exported.fmu(3), {"r_duty": 0.05, "margin_m": 0.03})
    same(answers(controller, run.x), run)
    # The states are those of other inputs.
    controller.set({"d_max": 0.2, "delta_rate_max_radps": 1.0, "sensor_tolerance": 0.0})
    tuned = answers(controller, run.x)
    assert tuned[:, 0].max() == 0.2
    assert np.abs(tuned[:, 1]).max() == 1.0
    assert (tuned[1:, 3] == Level.SOLUTION).all()  # the first has the car jump back


@pytest.mark.parametrize("connected", [False, True])
def test_it_is_as_cautious_as_in_lockstep(exported: Exported, connected: bool) -> None:
    """Also about what its model errs by, which it learns from its own outputs: means of inputs, so
    that they differ by rounding, and by what 150 steps make of it."""
    run = exported.lockstep()
    cautious = RACING.model_copy(update={"caution": 0.95})
    run.native.set_parameters(run.car, cautious)
    run.run(exported.circuit.start(v_mps=0.1), 150)
    values = {"caution_sigmas": cautious.caution_sigmas, "d_applied_connected": float(connected)}
    controller = exported.slave(exported.fmu(3), values)
    rows = []
    for k, x in enumerate(run.x):
        controller.set({"d_applied": run.u[k - 1][0] if k else 0.0})
        rows.append(answers(controller, [x])[0])
    same(np.array(rows), run, tolerance=1e-8)
    assert run.driver.output is not None
    widening = run.driver.output.numbers["widening"]
    assert controller.get("widening") == pytest.approx([widening], rel=1e-6)
    assert widening > 1


def test_a_speed_limit_slows_down_along_the_line_to_standstill(exported: Exported) -> None:
    start = exported.circuit.start(v_mps=1.5)
    controller = exported.slave(exported.fmu(3))
    car = exported.slave(packed_car(3), dict(zip(STATES, start, strict=True)))
    drive(car, controller, 50)
    controller.set({"speed_limit": 0.8})
    states, _ = drive(car, controller, 100)
    assert states[50:, 3].max() < 1.0
    for k in range(100):
        controller.set({"speed_limit": max(0.8 - 1.5 * STEP_S * k, 0.0), "speed_limit_rate": 1.5})
        states, _ = drive(car, controller, 1)
    assert abs(states[0, 3]) < 0.05
    assert controller.get("fallback_level") == [Level.SOLUTION]
    assert abs(controller.get("lateral_m")[0]) < 0.1


@pytest.mark.parametrize("h", [0.001, 0.005])
def test_a_short_communication_step_holds_the_outputs_for_a_period(
    exported: Exported, h: float
) -> None:
    run = exported.lockstep().run(exported.circuit.start(v_mps=1.0), 60)
    times = round(STEP_S / h)
    controller = exported.slave(exported.fmu(3))
    rows = answers(controller, [x for x in run.x for _ in range(times)], h)
    for offset in range(times):
        same(rows[offset::times], run)
    free = exported.slave(exported.fmu(3), {"period": 0.0}, "free")
    first = answers(free, [run.x[0]] * times, h)
    assert len({tuple(row[:2]) for row in first}) > 1


def test_what_acts_may_be_connected(exported: Exported) -> None:
    """By default it is what was sent; a car that does something else says so."""
    run = exported.lockstep().run(exported.circuit.start(v_mps=1.0), 50)
    connected = exported.slave(exported.fmu(3), {"d_applied_connected": 1.0})
    rows = []
    for k, x in enumerate(run.x):
        connected.set({"d_applied": run.u[k - 1][0] if k else 0.0})
        rows.append(answers(connected, [x])[0])
    same(np.array(rows), run)
    connected.set({"d_applied": -0.1})
    changed = answers(connected, [run.x[-1]])
    assert changed[0, 0] < rows[-1][0] - 0.01


def seen(slave: Slave, run: Lockstep) -> Floats:
    """What an FMU says in each period of four steps; one reading of an instrument comes a step."""
    rows, times = [], 4
    for k, (readings, applied) in enumerate(zip(run.readings, run.applied, strict=True)):
        queues: dict[str, list[Reading]] = {}
        for one in readings:
            queues.setdefault(one.instrument, []).append(one)
        slave.set(dict(zip(("d_applied", "delta_rate_applied"), applied, strict=True)))
        for left in range(times if k else 1, 0, -1):
            for queue in queues.values():
                if len(queue) == left:
                    one = queue.pop(0)
                    measured = {key: value for key, (value, _) in one.values.items()}
                    numbers = measured | {"time": one.time_s}
                    slave.set({f"sensor_{one.instrument}_{key}": numbers[key] for key in numbers})
            slave.time = k * STEP_S - (left - 1) * STEP_S / times  # not a sum of steps
            slave.step(STEP_S / times)
        rows.append(slave.get("d", "delta_rate", "status", "fallback_level"))
    return np.array(rows)


def test_a_car_that_instruments_measure_is_driven_as_in_lockstep(
    exported: Exported, tmp_path: Path
) -> None:
    """By late poses, wheel speed and gyro at rates of their own, with gaps and outliers."""
    run = exported.lockstep(sensors=odometry()).run(exported.circuit.start(v_mps=0.1), 250)
    assert [level for _, level in run.said].count(Level.SOLUTION) > 100
    car = exported.car.model_copy(update={"sensors": odometry()})
    fmu = pack(exported.define(car=car), tmp_path / "seen.fmu")
    assert validate_fmu(str(fmu)) == []
    controller = exported.slave(fmu, {"d_applied_connected": 1.0})
    assert "x" not in controller.references
    same(seen(controller, run), run, tolerance=1e-12)
    controller.reset()
    with pytest.raises(FMICallException):
        controller.initialise({"delay": STEP_S})
    assert "connect d_applied and delta_rate_applied" in controller.messages[-1]
    controller.reset()
    controller.initialise({"d_applied_connected": 1.0})
    same(seen(controller, run), run, tolerance=1e-12)
    for k in range(200):  # more readings than a control step takes
        names = ("sensor_pose_time", "sensor_wheel_time", "sensor_gyro_time")
        controller.set(dict.fromkeys(names, controller.time + 1e-4 * k))
        controller.step(0.001)
        assert np.isfinite(controller.get("d", "delta_rate")).all()


def test_instruments_whose_variables_would_have_one_name_are_refused(exported: Exported) -> None:
    [pose] = mocap().root.values()
    car = exported.car.model_copy(update={"sensors": Sensors({"a-b": pose, "a_b": pose})})
    with pytest.raises(InputError, match="rename one of"):
        exported.define(car=car)
