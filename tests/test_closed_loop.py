"""The closed loop in one process: the same run, to the bit, as two processes over Zenoh."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import read_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY, TRUTH, Event, State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.collect import collect
from bayesrace.operation.drive import execute
from bayesrace.operation.run_plan import RunPlan
from bayesrace.plant.simulator import Simulator
from bayesrace.plant.vehicle import Command, FmuFault
from bayesrace.raceline import read_raceline
from bayesrace.recorder import Recorder
from bayesrace.sensors import get_sensors
from bayesrace.tracks import load_track
from bayesrace.transport import Director, Endpoints, Publisher, free_endpoint, open_session
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import Circuit
from tests.network.cars import gentle_course, start_controller, start_plant
from tests.programs import PATIENCE_S

PLANS = (
    RunPlan(1, "one lap", 1, 100.0, True),
    RunPlan(2, "the time is up", 0, 1.0, True, start_speed_mps=0.5),
)
CLOCKS = {
    "source_time_ns", "epoch", "released_ns", "received_ns", "wake_us", "decode_us", "prepare_us",
    "solve_us", "encode_us",
}  # fmt: skip
"""Fields that differ from run to run."""


def told(log: Path) -> list[dict[str, Any]]:
    """States, their truth, actuations and telemetry, all fields but the clocks', and how the runs
    ended."""
    reader = LogReader(log)
    messages = [entry.message for entry in reader.messages((STATE, TRUTH, ACTUATION, TELEMETRY))]
    messages.sort(key=lambda one: (type(one).__name__, one.seq))
    rows = [
        {name: getattr(message, name) for name in message.__struct_fields__ if name not in CLOCKS}
        for message in messages
    ]
    ends = [
        {name: event.data[name] for name in ("reason", "time_s", "laps", "braked", "clipped")}
        for event in reader.select(EVENT)
        if event.kind == "run_ended"
    ]
    assert reader.refused == 0
    assert len(ends) == len(PLANS)
    return rows + ends


def assert_played_as_driven(log: Path, begin_ns: int) -> None:
    """The log plays as long as the car drove; each cycle has the time of its state. When each
    message came is beside it."""
    entries = list(LogReader(log).messages((STATE, ACTUATION, TELEMETRY)))
    states = {entry.message.seq: entry for entry in entries if isinstance(entry.message, State)}
    first, last = (states[seq] for seq in (min(states), max(states)))
    driven_s = sum(one.message.time_s for one in states.values() if one.message.final)
    assert (last.log_time_ns - first.log_time_ns) * 1e-9 == pytest.approx(driven_s, abs=1e-6)
    for entry in entries:
        seq = getattr(entry.message, "state_seq", entry.message.seq)
        assert entry.log_time_ns == states[seq].log_time_ns
        assert begin_ns < entry.wall_ns < time.time_ns()


@pytest.mark.parametrize(
    ("options", "disturbances"),
    [
        ((), {}),
        (
            ("--delay", "7", "--sensors", "odometry", "--seed", "3"),
            {"delay_s": 0.007, "seed": 3, "sensors": get_sensors("odometry")},
        ),
    ],
    ids=["exact", "instruments and delay"],
)
def test_a_run_is_that_of_two_processes_over_zenoh_to_the_bit(
    tmp_path: Path, car: Car, options: tuple[str, ...], disturbances: dict[str, Any]
) -> None:
    course, begin_ns = gentle_course(tmp_path, speed_mps=2.5), time.time_ns()
    track, line = load_track(course.track_file, car.width_m), read_raceline(course.line_file)
    at_plant, at_controller = free_endpoint(), free_endpoint()
    with (
        start_plant(tmp_path, at_plant, "--low-latency", *options) as plant,
        start_controller(tmp_path, course, at_plant, at_controller, "--low-latency") as controller,
        open_session(Endpoints(connect=(at_plant, at_controller))) as session,
        Recorder(session, "orca", tmp_path / "zenoh.mcap") as recorder,
    ):
        director = Director(session, "orca")
        director.wait_for(("plant", "controller"), PATIENCE_S)
        events: Publisher[Event] = Publisher(session, EVENT, "orca", "race")
        for plan in PLANS:
            execute(director, events, track, plan, recorder)
        controller.end()
        plant.end()

    weights = read_weights(course.weights_file)
    compiled = compiled_controller(course.artefact, car, track, line, weights)
    log = LogWriter(tmp_path / "own.mcap")
    loop = ClosedLoop(car, track, line, compiled, log=log, **disturbances)
    driven = [
        loop.drive(plan.laps, plan.max_time_s, plan.start_speed_mps, name=plan.controller)
        for plan in PLANS
    ]
    log.close()
    assert told(tmp_path / "own.mcap") == told(tmp_path / "zenoh.mcap")
    for name in ("own", "zenoh"):
        assert_played_as_driven(tmp_path / f"{name}.mcap", begin_ns)
    first, second = driven
    assert (first.end.reason, second.end.reason) == ("laps", "max_time")
    assert len(first.laps_s) == first.lap[-1] == 1
    assert first.time_s[-2] <= first.laps_s[0] <= first.time_s[-1]
    assert first.x[:, 3].max() > 1.8
    assert second.x.shape == (51, 7)
    assert second.u.shape == (*second.levels.shape, 2) == (50, 2)
    assert not second.statuses[8:].any()  # until then there may be no pose
    measured = np.array([state.x for state in second.states])
    assert np.array_equal(measured, second.x) == (not disturbances)
    assert any(state.readings for state in second.states) == bool(disturbances)
    truth = LogReader(tmp_path / "own.mcap").select(TRUTH)
    assert len(truth) == len(LogReader(tmp_path / "own.mcap").select(STATE))
    for run, one in enumerate(driven, 1):
        assert np.array_equal(one.x, [sample.x for sample in truth if sample.run == run])


class Failing(Simulator):
    """A car that fails after a second."""

    def step(self, u: Command) -> None:
        """As the built-in car, 50 times."""
        if self.steps == 50:
            raise FmuFault("it has crashed")
        super().step(u)


def test_a_fault_of_the_car_ends_the_run(
    circuit: Circuit, car: Car, kinematic_artefact: Path, tmp_path: Path
) -> None:
    line, vehicle = circuit.line, Failing(dynamic(car))
    law = PurePursuit(car, line.x_m, line.y_m, line.vx_mps)
    pursuit = PythonController(kinematic_artefact, law)
    driven = ClosedLoop(car, circuit.track, line, pursuit, vehicle).drive()
    assert driven.end.reason == "plant_fault"
    assert len(driven.x) == len(driven.u) + 1 == 51
    assert len(driven.samples()) > 40
    log = tmp_path / "log.mcap"
    arguments = circuit.track, line, car, kinematic_artefact, log, 2.0, PurePursuitSettings()
    with pytest.raises(FmuFault, match="it has crashed"):
        collect(*arguments, vehicle=vehicle)


def test_without_track_constraints_another_problem_is_solved(
    circuit: Circuit, car: Car, kinematic_artefact: Path
) -> None:
    def controller(constraints: bool) -> PredictiveController:
        settings = MpcSettings(constraints=constraints)
        return compiled_controller(
            kinematic_artefact, car, circuit.track, circuit.line, settings=settings
        )

    driven = [
        ClosedLoop(car, circuit.track, circuit.line, controller(one)).drive(0, 2.0)
        for one in (True, False)
    ]
    assert not np.array_equal(driven[0].x, driven[1].x)
