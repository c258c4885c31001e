"""The loops of plant and controller on a simulated clock and network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace import clock
from bayesrace.controller.assembly import (
    PredictiveController,
    compiled_controller,
    predictive_controller,
)
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, encode_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY, TRUTH, Event, Topic
from bayesrace.operation.analysis.laps import laps_in
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.simulation import SimulatedSystem
from bayesrace.operation.simulation.scheduler import Scheduler
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.raceline import RaceLine, racing_line, write_raceline
from bayesrace.tracks import write_track
from bayesrace.transport.relay import Link
from bayesrace.vehicles import Car
from tests.conftest import Circuit

LAP = RunPlan(1, "test", 1, 12.0, lockstep=False)
BAD = Link(0.01, 0.005, 0.01)

Drive = Callable[..., "Recorded"]


class Recorded:
    """A run, by its log."""

    def __init__(self, log: Path, system: SimulatedSystem, end: Event, circuit: Circuit) -> None:
        self.reader, self.end, self._circuit = LogReader(log), end, circuit
        self.plant: Any = system.status("plant").counters
        self.controller: Any = system.status("controller").counters

    def messages(self, topic: Topic[Any]) -> list[Any]:
        return self.reader.select(topic)

    def events(self, kind: str) -> list[Event]:
        return [one for one in self.messages(EVENT) if one.kind == kind]

    @property
    def off_track(self) -> int:
        return int((laps_in(self.reader.path, 1, self._circuit.track).off_track_m > 0).sum())


@pytest.fixture(scope="module")
def line(circuit: Circuit, car: Car) -> RaceLine:
    """At the limit of the car."""
    return racing_line(circuit.track, car)


@pytest.fixture
def best_case(
    dynamic_artefact: Path, circuit: Circuit, car: Car, line: RaceLine
) -> Callable[[], PredictiveController]:
    """Predicts as the plant drives."""
    return lambda: compiled_controller(dynamic_artefact, car, circuit.track, line)


@pytest.fixture
def drive(
    tmp_path: Path, circuit: Circuit, car: Car, best_case: Callable[[], PredictiveController]
) -> Drive:
    """Drives a lap; ``happens`` gets the system before."""

    def driven(
        happens: Callable[[SimulatedSystem], object] = lambda _: None, plan: RunPlan = LAP,
        make: Callable[[], PredictiveController] = best_case, buffer_s: float = 0.0,
        **settings: Any,
    ) -> Recorded:  # fmt: skip
        log = tmp_path / f"{len(list(tmp_path.glob('*.mcap')))}.mcap"
        writer, plant = LogWriter(log), PlantSettings(car=car, buffer_s=buffer_s)
        with SimulatedSystem(circuit.track, make, writer, plant, **settings) as system:
            happens(system)
            end = system.drive(plan)
            recorded = Recorded(log, system, end, circuit)
        writer.close()
        return recorded

    return driven


def test_tasks_run_in_the_order_of_their_deadlines() -> None:
    scheduler, seen = Scheduler(), list[tuple[str, int]]()
    begin_ns = scheduler.monotonic_ns()

    def live(name: str, period_ns: int) -> None:
        while True:
            seen.append((name, scheduler.monotonic_ns() - begin_ns))
            scheduler.sleep_until_ns(scheduler.monotonic_ns() + period_ns)

    slow, fast = (
        scheduler.start(name, lambda name=name, ns=ns: live(name, ns))  # type: ignore[misc]
        for name, ns in (("slow", 3), ("fast", 2))
    )
    scheduler.sleep_until_ns(begin_ns + 5)
    fast.paused_until_ns = begin_ns + 9
    scheduler.call_at(begin_ns + 7, lambda: seen.append(("call", 7)))
    scheduler.sleep_until_ns(begin_ns + 10)
    happened = seen.copy()
    for task in (slow, fast):
        scheduler.end(task)
    assert happened == [
        ("slow", 0), ("fast", 0), ("fast", 2), ("slow", 3), ("fast", 4), ("slow", 6), ("call", 7),
        ("slow", 9), ("fast", 9),
    ]  # fmt: skip


def test_a_run_is_the_same_to_the_bit_over_a_bad_link(drive: Drive) -> None:
    one, two, other = drive(link=BAD), drive(link=BAD), drive(link=BAD, seed=1)
    for topic in (STATE, TRUTH, ACTUATION, TELEMETRY, EVENT):
        assert one.messages(topic) == two.messages(topic)
    assert one.messages(ACTUATION) != other.messages(ACTUATION)
    assert one.end.data["reason"] == "laps"
    assert one.off_track == 0


def test_over_a_perfect_link_each_state_is_answered_in_time(drive: Drive) -> None:
    recorded = drive()
    assert recorded.end.data["reason"] == "laps"
    assert recorded.off_track == 0
    for count in ("skipped", "deadline_misses", "late_states", "states_lost"):
        assert recorded.controller[count] == 0
    assert recorded.plant["late"] == recorded.plant["stale"] == 0


def test_what_a_link_loses_is_counted(drive: Drive) -> None:
    recorded = drive(link=Link(0.005, loss=0.05, ordered=False))
    lost = recorded.controller["states_lost"]
    received = recorded.controller["states_received"]
    assert lost > 0
    # those on their way at the end are neither
    assert abs(len(recorded.messages(STATE)) - received - lost) <= 2
    assert recorded.plant["actuations_lost"] > 0


def delays_s(recorded: Recorded) -> list[float]:
    """From the decision on each input that acted until it did."""
    reports = (one.actuation_delays[2::3] for one in recorded.messages(STATE))
    return [delay_s for report in reports for delay_s in report if delay_s >= 0]


def test_inputs_that_arrive_at_once_count_as_one_and_do_not_change_the_delay(drive: Drive) -> None:
    """After a link was held up, all but the newest are old, and never act."""

    def happens(system: SimulatedSystem) -> None:
        for after_s in (1.0, 1.3):
            system.at(after_s, system.ways["plant"].hold)
            system.at(after_s + 0.15, system.ways["plant"].release)

    recorded = drive(happens, link=Link(0.01))
    arrived = sum(len(one.actuation_delays) // 3 for one in recorded.messages(STATE))
    assert arrived - len(delays_s(recorded)) >= 10
    known = [one.delay_s for one in recorded.messages(TELEMETRY)[20:]]
    assert max(known) < min(known) + 0.005
    assert recorded.off_track == 0


def test_a_jitter_buffer_makes_delays_that_vary_constant(drive: Drive) -> None:
    rough = Link(0.03, 0.03, 0.02, ordered=False)
    bare, buffered = drive(link=rough), drive(link=rough, buffer_s=0.1)
    spread_s = [np.ptp(np.percentile(delays_s(one), (2, 95))) for one in (bare, buffered)]
    assert spread_s[0] > 0.04
    assert spread_s[1] < 0.005
    assert min(delays_s(buffered)) >= 0.1 - 1e-6
    assert bare.off_track > buffered.off_track == 0
    assert buffered.end.data["reason"] == "laps"


def test_a_controller_that_is_stopped_for_a_while_goes_on(drive: Drive) -> None:
    recorded = drive(lambda system: system.at(1.5, lambda: system.pause("controller", 0.3)))
    assert recorded.controller["skipped"] >= 10
    assert recorded.plant["planned"] > 0
    assert recorded.off_track == 0
    assert recorded.end.data["reason"] == "laps"


def test_a_partition_in_one_direction_is_bridged_by_the_braking_plan(drive: Drive) -> None:
    def happens(system: SimulatedSystem) -> None:
        system.at(1.0, system.ways["plant"].hold)
        system.at(1.5, system.ways["plant"].release)

    recorded = drive(happens)
    assert recorded.plant["planned"] > 0
    assert recorded.off_track == 0
    assert recorded.end.data["reason"] == "laps"


def test_a_controller_that_is_killed_is_started_again(drive: Drive) -> None:
    def happens(system: SimulatedSystem) -> None:
        system.at(1.0, lambda: system.kill("controller"))
        system.at(4.0, lambda: system.start("controller"))

    recorded = drive(happens)
    assert recorded.off_track == 0
    assert min(one.x[3] for one in recorded.messages(TRUTH)[100:200]) < 0.1
    assert recorded.end.data["reason"] == "laps"


def test_stop_go_and_new_weights(
    drive: Drive, tmp_path: Path, kinematic_artefact: Path, circuit: Circuit, car: Car,
    line: RaceLine, weights: Weights,
) -> None:  # fmt: skip
    files = tmp_path / "track.csv", tmp_path / "line.csv"
    write_track(files[0], circuit.track)
    write_raceline(files[1], line)

    def make() -> PredictiveController:
        return predictive_controller(kinematic_artefact, car, *files)

    def happens(system: SimulatedSystem) -> None:
        system.at(1.0, lambda: answers.append(system.publish(encode_weights(weights))))
        system.at(2.0, lambda: answers.append(system.stop()))
        system.at(4.0, lambda: answers.append(system.go()))

    answers: list[Any] = []
    one, two = drive(happens, make=make), drive(happens, make=make)
    assert all(answer.accepted for answer in answers), answers
    assert len(one.events("weights_accepted")) == 1
    assert one.messages(ACTUATION) == two.messages(ACTUATION)
    assert {one.weights_version for one in one.messages(ACTUATION)} == {"", weights.version}


def test_a_fault_of_a_simulated_process_is_raised(drive: Drive) -> None:
    def happens(system: SimulatedSystem) -> None:
        assert system.controller is not None
        system.controller._tick = None  # type: ignore[assignment,method-assign]

    with pytest.raises(RuntimeError, match="simulated controller"):
        drive(happens)
    assert clock.monotonic_ns.__module__ == "time"


def test_what_cannot_happen_is_refused(drive: Drive) -> None:
    with pytest.raises(InputError, match="runs already"):
        drive(lambda system: system.start("plant"))
    with pytest.raises(InputError, match="does not run"):
        drive(lambda system: (system.kill("controller"), system.kill("controller")))
