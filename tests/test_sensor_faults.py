"""A sensor that fails at racing speed: it is noticed, named and counted, and the car stays on its
track; and no false alarm, whatever is driven and with the noise of motion capture.

What is not among these: errors that look like driving, such as a speed 10 % too high or a position
that drifts (docs/faults.md).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.driver import Level
from bayesrace.messages import State
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.plant.car import End
from bayesrace.plant.faults import STATE_FAULTS, StateFault
from bayesrace.vehicles import get_car
from tests.exchanged import Alike, answered_alike, racing_host
from tests.racing import Racing, racing

__all__ = ["answered_alike", "racing_host"]  # fixtures

STEP_S = 0.02
BEGIN_S = 0.6
"""A drive that starts at speed has found its line by then."""
MOCAP = (0.001, 0.001, math.radians(0.5), 0.05, 0.05, 0.2, 0.0005)
"""Standard deviations of states that are made of motion capture."""

EVER = 1000
# Name: the fault, for how many states it lasts, how many may be believed, whether the car goes on.
FAULTS: dict[str, tuple[StateFault, int, int, bool]] = {
    name: (STATE_FAULTS[name], EVER, believed, goes_on)
    for name, believed, goes_on in (
        ("frozen", 1, False),
        ("position frozen", 2, False),
        ("jumped by 0.1 m", 0, False),
        ("heading turned round", 0, False),
        ("heading in degrees", 1, False),
        ("speed in km/h", 0, False),
        ("position in mm", 0, False),
        ("vy, omega, delta at 0", 3, False),
        ("omega mirrored", 3, False),
        ("mirrored", 0, False),
        ("x and y exchanged", 0, False),
        ("vx and vy exchanged", 0, False),
        ("late by 5 periods", 1, False),
        ("dated 0.1 s ahead", 0, True),
        ("every fifth only", 1, False),
    )
} | {
    "frozen for 2 s": (STATE_FAULTS["frozen"], 100, 1, False),
    "jumped by 1 m": (STATE_FAULTS["jumped by 1 m"], 50, 0, False),
    "vx negative for 0.1 s": (STATE_FAULTS["vx negative"], 5, 0, True),
}


class Faulty(ClosedLoop):
    """A car whose sensors fail."""

    def fail(self, fault: StateFault, lasts: int) -> None:
        self._fault, self._end_s = fault, BEGIN_S + lasts * STEP_S
        self._since: list[State] = []
        self.faults: list[str] = []
        """Of each state from the beginning on."""
        self.decided_s: list[float] = []

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        if state.time_s >= BEGIN_S - 1e-9:
            self._since.append(state)
            if state.time_s < self._end_s - 1e-9:
                state = self._fault(self._since)
        answer = super()._exchange(state, x)
        self.decided_s.append(self._cycle.driver.decision.decided_at_s)
        if self._since:
            self.faults.append(self._cycle.driver.fault)
        return answer


@pytest.fixture(scope="module")
def race() -> Racing:
    return racing()


@pytest.mark.parametrize("place", [0.1, 0.45, 0.8])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_noticed_and_the_car_stays_on_its_track(
    race: Racing, name: str, place: float
) -> None:
    fault, lasts, believed, goes_on = FAULTS[name]
    loop = Faulty(race.car, race.track, race.line, race.controller())
    loop.fail(fault, lasts)
    start = race.moments(100)[round(100 * place)]
    driven = loop.drive(0, max_time_s=BEGIN_S + 3.2, x0=start)
    assert race.off_track_m(driven.x) <= 0
    assert loop.faults.index(next(filter(None, loop.faults))) <= believed
    assert loop._cycle.driver.faults == {
        kind: loop.faults.count(kind) for kind in loop._cycle.driver.faults
    }
    assert set(driven.levels[: round(BEGIN_S / STEP_S)]) == {Level.SOLUTION}
    if goes_on:
        assert driven.levels[-1] == Level.SOLUTION
        assert abs(driven.x[-1, 3]) > 0.5
    else:
        assert abs(driven.x[-1, 3]) < 0.05
        assert driven.levels[-1] == Level.STOP


def test_states_that_are_dated_ahead_are_answered_for_the_moment_that_is(race: Racing) -> None:
    """Else the car refuses the answer, or what it does after the last one begins too early."""
    loop = Faulty(race.car, race.track, race.line, race.controller())
    loop.fail(STATE_FAULTS["dated 0.1 s ahead"], EVER)
    loop.drive(0, max_time_s=BEGIN_S + 0.5, x0=race.moments(100)[45])
    assert len(loop.decided_s) > 50
    decided_s = loop.decided_s[:-1]  # the last state is not answered
    np.testing.assert_allclose(decided_s, STEP_S * np.arange(len(decided_s)), atol=1e-9)


@pytest.mark.parametrize("name", FAULTS)
def test_the_controller_without_python_does_the_same(
    race: Racing, answered_alike: Alike, name: str
) -> None:
    test_a_fault_is_noticed_and_the_car_stays_on_its_track(race, name, 0.45)
    assert answered_alike() > 100


def test_a_car_that_has_stopped_drives_on_when_it_is_told_to(race: Racing) -> None:
    loop = Faulty(race.car, race.track, race.line, race.controller())
    loop.fail(*FAULTS["frozen for 2 s"][:2])
    driver = loop._cycle.driver
    stopped = loop.drive(0, max_time_s=BEGIN_S + 4, x0=race.moments(4)[1])
    assert driver.fault == "elsewhere" or abs(stopped.x[-1, 3]) < 0.05
    driver.go()
    loop.fail(FAULTS["frozen"][0], 0)
    again = loop.drive(0, max_time_s=2.0, x0=stopped.true_x[-1])
    assert again.x[-1, 3] > 1
    assert not any(loop.faults)


# False alarms --------------------------------------------------------------------------------


class Noisy(ClosedLoop):
    """A car whose states are measured with noise of these standard deviations."""

    noise: Sequence[float] = (0.0,) * 7
    random = np.random.default_rng(0)

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        noisy = tuple(self.random.normal(x, self.noise).tolist())
        return super()._exchange(replace(state, x=noisy), x)


def alarms(race: Racing, **how: Any) -> dict[str, int]:
    """Of a drive; the options of ClosedLoop, ``weights``, ``noise``, and those of its drive."""
    weights = how.pop("weights", race.weights)
    start: Any = how.pop("start", None)
    controller = compiled_controller(race.artefact, race.car, race.track, race.line, weights)
    noise = how.pop("noise", Noisy.noise)
    loop = Noisy(race.car, race.track, race.line, controller, **how)
    loop.noise, loop.random = noise, np.random.default_rng(0)
    loop.drive(2, max_time_s=12.0, x0=start)
    return {kind: count for kind, count in loop._cycle.driver.faults.items() if count}


def slippery() -> Any:
    car = get_car("orca")
    return built_in_car(car.model_copy(update={"tyres": car.true_tyres.with_grip(0.8)}))


DRIVES: dict[str, Callable[[Racing], dict[str, Any]]] = {
    "learned": lambda _: {},
    "learned, noise": lambda _: {"noise": MOCAP},
    "uncorrected, sliding": lambda _: {"weights": None},
    "uncorrected, noise": lambda _: {"weights": None, "noise": MOCAP},
    "grip 0.8": lambda _: {"vehicle": slippery()},
    "delay, noise": lambda _: {"delay_s": 0.02, "noise": MOCAP},
    "spinning": lambda race: {"start": race.moments(4)[1] + (0, 0, 0.5, 0, 1, 15, 0)},
    "turning round": lambda race: {"start": race.moments(4)[1] * (1, 1, 0, 0, 0, 0, 0)},
}


@pytest.mark.parametrize("name", DRIVES)
def test_no_alarm_without_a_fault(race: Racing, name: str) -> None:
    assert alarms(race, **DRIVES[name](race)) == {}


@pytest.mark.check
@pytest.mark.parametrize("seed", range(1, 41))
def test_no_alarm_on_random_tracks(seed: int) -> None:
    race = racing(f"random:{seed}")
    for how in ({}, {"noise": MOCAP}, {"vehicle": slippery(), "noise": MOCAP}):
        assert alarms(race, **how) == {}


def test_samples_that_are_not_believed_are_not_learned_from(race: Racing) -> None:
    loop = Faulty(race.car, race.track, race.line, race.controller())
    loop.fail(*FAULTS["vx negative for 0.1 s"][:2])
    driven: Driven = loop.drive(0, max_time_s=BEGIN_S + 2.0, x0=race.moments(4)[1])
    samples = driven.samples()
    assert (samples.x[:, 3] > 0).all()
    assert np.isfinite(samples.x_next).all()
    assert driven.faults.any()
    left_out = len(driven.states) - 1 - len(samples.x)
    assert left_out >= 20
    assert left_out < 40
