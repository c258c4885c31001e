"""The controller process's loop in real time, in simulated time: states come when the test says.

No clock is read and nothing waits, so no stall of the machine changes an outcome.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

import bayesrace.clock
from bayesrace.arrays import Floats
from bayesrace.controller.interface import Environment, StepOutput
from bayesrace.controller.process import ControllerProcess, ControllerSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import Adoption, Task
from bayesrace.messages import Actuation, State, Telemetry, decode, encode
from bayesrace.transport import Item, Kind
from bayesrace.vehicles import get_car
from tests.cycle_rig import ScriptedLaw, state
from tests.instruments import reading

MS = 1_000_000
BEGIN_NS = 1000 * MS
TRANSPORT_NS = MS // 2
"""From the sampling of a state to its arrival, if nothing holds it up."""


@dataclass
class Clock:
    """Stands in for :mod:`bayesrace.clock`; time passes in sleep, and where the test lets it. Who
    sleeps to a deadline wakes 30 us late."""

    now_ns: int = BEGIN_NS

    def monotonic_ns(self) -> int:
        return self.now_ns

    perf_counter_ns = monotonic_ns

    def monotonic(self) -> float:
        return self.now_ns * 1e-9

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self.now_ns = max(self.now_ns, deadline_ns + 30_000)


class Law(ScriptedLaw):
    """Stands still, which takes some time; notes the time between two steps."""

    def __init__(self, clock: Clock, takes_ns: int) -> None:
        super().__init__(lambda _: StepOutput(u=np.zeros(2)))
        self.elapsed_s: list[float] = []
        self._clock, self._takes_ns = clock, takes_ns

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment,
        elapsed_s: float,
        budget_s: float = 0.0,
    ) -> StepOutput:
        self.elapsed_s.append(elapsed_s)
        self._clock.now_ns += self._takes_ns
        return super().step(x, u_previous, environment, elapsed_s, budget_s)


@dataclass
class Loop:
    """A controller process whose states arrive at their time; it ends after the last one."""

    artefact: Path
    rate_hz: float = 50.0
    cycle_ns: int = 400_000
    clock: Clock = field(default_factory=Clock)
    actuations: list[Actuation] = field(default_factory=list)
    telemetry: list[Telemetry] = field(default_factory=list)
    prepared_s: list[float] = field(default_factory=list)
    """The time that each preparation expected until the next step."""

    def __post_init__(self) -> None:
        self.period_ns = round(1e9 / self.rate_hz)
        self._coming: deque[tuple[int, State]] = deque()
        self.law = Law(self.clock, self.cycle_ns)
        self.controller = PythonController(self.artefact, self.law)
        settings = ControllerSettings(rate_hz=self.rate_hz, budget=0.8)
        session = MagicMock()
        session.declare_subscriber.return_value = SimpleNamespace(
            handler=SimpleNamespace(try_recv=self._arrived)
        )
        session.declare_publisher.side_effect = lambda key, **_: SimpleNamespace(
            put=lambda data: self._sent(key, data)
        )
        self.process = ControllerProcess(session, settings, self.controller)
        prepare = self.process._cycle.prepare

        def noted(period_s: float, budget_s: float) -> None:
            self.prepared_s.append(period_s)
            prepare(period_s, budget_s)

        self.process._cycle.prepare = noted  # type: ignore[method-assign]

    def run(
        self,
        count: int,
        held_up_ns: dict[int, int],
        final: int = -1,
        seen: Callable[[int], dict[str, Any]] = lambda _: {},
    ) -> dict[str, Any]:
        """Drives through so many states, of which some are held up; returns the counters.

        A state held up for ever is lost. ``seen``: what else is in each, by its number.
        """
        for seq in range(count):
            changes = {"time_s": seq * self.period_ns * 1e-9, "final": seq == final} | seen(seq)
            one = state(seq, **changes)
            self._coming.append((self.arrival_ns(seq, held_up_ns.get(seq, 0)), one))
        self._coming = deque(one for one in self._coming if one[0] < self.arrival_ns(count))
        self.process.serve()
        return self.process._counters()

    def arrival_ns(self, seq: int, held_up_ns: int = 0) -> int:
        return BEGIN_NS + seq * self.period_ns + TRANSPORT_NS + held_up_ns

    def answered_ns(self, seq: int) -> int | None:
        """How long after the usual time of its arrival a state was answered first."""
        made = [one.source_time_ns for one in self.actuations if one.state_seq == seq]
        return made[0] - self.arrival_ns(seq) if made else None

    def answers(self) -> list[tuple[int, int]]:
        """Each cycle's release, and the state that it answered."""
        return [(one.tick, one.state_seq) for one in self.telemetry]

    def _arrived(self) -> Any:
        if not self._coming:
            self.process.inbox.put(Item(Kind.SIGNAL, "", 15, 0))
        elif self._coming[0][0] <= self.clock.now_ns:
            data = encode(self._coming.popleft()[1])
            return SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: data))
        return None

    def _sent(self, key: str, data: bytes) -> None:
        if key.endswith("/actuation"):
            self.actuations.append(decode(Actuation, data))
        elif key.endswith("/telemetry"):
            self.telemetry.append(decode(Telemetry, data))


Make = Callable[..., Loop]


@pytest.fixture
def loop(kinematic_artefact: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes a loop in simulated time."""
    clock = Clock()
    for name in ("monotonic_ns", "monotonic", "perf_counter_ns", "sleep", "sleep_until_ns"):
        monkeypatch.setattr(bayesrace.clock, name, getattr(clock, name))
    return lambda **settings: Loop(kinematic_artefact, clock=clock, **settings)


def test_states_in_time_are_answered_at_once_each_by_a_cycle(loop: Make) -> None:
    driven = loop()
    counters = driven.run(20, {})
    assert driven.answers() == [(k, k) for k in range(20)]
    assert all((driven.answered_ns(k) or 0) < MS for k in range(20))
    assert (counters["late_states"], counters["skipped"], counters["deadline_misses"]) == (0, 0, 0)


@pytest.mark.parametrize("held_up_ms", [5.5, 9.0, 14.0])
def test_a_state_that_comes_after_its_window_is_answered_when_it_comes(
    loop: Make, held_up_ms: float
) -> None:
    driven = loop()
    counters = driven.run(20, {8: round(held_up_ms * MS)})
    ticks = [*range(9), *range(8, 20)]  # the ninth release has two cycles
    assert driven.answers() == list(zip(ticks, [*range(8), 7, *range(8, 20)], strict=True))
    assert (driven.answered_ns(8) or 0) < held_up_ms * MS + MS
    assert (counters["late_states"], counters["skipped"], counters["deadline_misses"]) == (1, 0, 0)
    assert (counters["ticks"], counters["overruns"]) == (21, 0)
    assert [one.wake_us for one in driven.telemetry[8:11]] == [30.0, 0.0, 30.0]


def test_a_state_that_comes_too_late_for_that_leaves_the_next_one_in_time(loop: Make) -> None:
    """It waits for the next release, at which a newer one is due: that one counts, and the loop
    does not stay a state behind from then on."""
    driven = loop()
    counters = driven.run(20, {8: 17 * MS})
    assert driven.answers() == [(k, k if k != 8 else 7) for k in range(20)]
    assert all((driven.answered_ns(k) or 0) < MS for k in range(20) if k != 8)
    assert counters["late_states"] == 0


def test_it_is_answered_at_the_next_release_where_no_newer_one_comes(loop: Make) -> None:
    driven = loop()
    counters = driven.run(20, {8: 17 * MS, 9: 10_000 * MS})
    answers = driven.answers()
    assert answers[8:11] == [(8, 7), (9, 8), (10, 10)]
    assert (counters["late_states"], counters["states_lost"]) == (0, 1)


def test_a_plant_that_has_fallen_behind_gets_no_late_cycles(loop: Make) -> None:
    """It needs the CPU that they would take to catch up."""
    driven = loop()
    counters = driven.run(30, dict.fromkeys(range(10, 20), 49 * MS))
    assert counters["late_states"] == 0
    assert [seq for _, seq in driven.answers()[-8:]] == [*range(22, 30)]


def test_where_a_cycle_hardly_fits_into_the_period_there_is_no_second_one(loop: Make) -> None:
    driven = loop(rate_hz=500.0, cycle_ns=500_000)
    counters = driven.run(200, {80: 900_000})
    assert driven.answers() == [(k, k if k != 80 else 79) for k in range(200)]
    assert (counters["late_states"], counters["skipped"], counters["deadline_misses"]) == (0, 0, 0)


def test_states_that_come_less_often_than_releases_are_answered_when_they_come(loop: Make) -> None:
    driven = loop(rate_hz=100.0)
    driven.period_ns *= 2
    counters = driven.run(20, {8: 6 * MS})
    seen = [seq for _, seq in driven.answers()]
    assert seen[16:20] == [7, 8, 8, 9]
    assert (driven.answered_ns(8) or 0) < 7 * MS
    assert (counters["late_states"], counters["ticks"]) == (1, len(seen))


def test_the_step_knows_how_much_time_has_passed_in_both_cycles(loop: Make) -> None:
    """The plan is shifted by the time between two steps, whatever their number in a period."""
    driven = loop()
    driven.run(20, {8: 9 * MS})
    released_s = np.array([one.released_ns for one in driven.telemetry]) * 1e-9
    assert driven.law.elapsed_s[1:] == pytest.approx(np.diff(released_s), abs=1e-4)
    assert driven.law.elapsed_s[8:11] == pytest.approx([0.025, 0.004, 0.011], abs=5e-4)
    # A preparation is for the next release, however long ago the cycle was.
    assert driven.prepared_s[7:10] == pytest.approx([0.02, 0.011, 0.02], abs=5e-4)


def test_a_final_state_that_comes_late_ends_the_run_without_an_answer(loop: Make) -> None:
    driven = loop()
    counters = driven.run(12, {11: 9 * MS}, final=11)
    assert driven.answers()[-1] == (11, 10)
    assert counters["late_states"] == 0
    assert driven.process._driver.phase == "waiting"


def test_new_weights_come_after_both_cycles_of_a_release(
    loop: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cycle that is named as their first one is."""
    driven = loop()

    def adopt(version: str) -> None:
        driven.controller.weights_version = version

    native = SimpleNamespace(adopt_weights=adopt, prove_weights=lambda: None)
    history = SimpleNamespace(in_use=SimpleNamespace(proven=True))
    port: Any = SimpleNamespace(step=native, car=get_car("orca"), history=history)
    adoption = driven.process._adoption = Adoption(port, GateSettings())
    task = Task(lambda: adoption.use("new", watched=False), 0)
    step = driven.law.step

    def offering(*arguments: Any) -> StepOutput:
        if len(driven.telemetry) == 8:  # in the cycle before the late one
            adoption.tasks.append(task)
        return step(*arguments)

    monkeypatch.setattr(driven.law, "step", offering)
    driven.run(20, {8: 9 * MS})
    drives = [one.weights_version == "new" for one in driven.actuations]
    assert drives == [False] * 10 + [True] * 11
    assert list(adoption.done) == [(driven.telemetry[10].tick, task)]


def test_new_weights_are_on_probation_while_the_car_is_driven_by_its_states(loop: Make) -> None:
    """Also if an instrument is faulty without which it is driven; not before its state is known."""

    def seen(seq: int) -> dict[str, Any]:
        time_s, x = seq * 0.02, float(seq >= 40)
        pose = reading("pose", time_s, (1e-3, 1e-3, 3e-3), x=x, y=0.0, psi=0.0)
        wheel = reading("wheel", time_s, (0.01,), vx=3.0 * (seq >= 20))
        return {"estimated": True, "readings": (pose, wheel) if seq >= 5 else ()}

    driven, counted = loop(), list[int]()
    driver = driven.process._driver
    faulty = dict[int, str]()

    def observe(*_: Any) -> None:
        assert driver.newest is not None
        counted.append(driver.newest.seq)
        faulty[counted[-1]] = driver.faulty

    driven.process._adoption = MagicMock(
        observe=observe, limits=lambda _: None, between_cycles=lambda _: None
    )
    driven.run(60, {}, seen=seen)
    assert counted == list(range(5, counted[-1] + 1))
    assert 40 <= counted[-1] < 44  # the fifth pose in a row ends it, if not its covariance
    assert {faulty[seq] for seq in range(24, 40)} == {"wheel"}
