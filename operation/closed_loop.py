"""Plant and controller in one process: a lockstep run without network, clock or other processes.

The car is driven by the plant's own lockstep loop and the controller's own cycle, so a run is
equal to the bit to the same run of two processes over Zenoh (tests/test_closed_loop.py). New
weights are the caller's: nothing validates them, and no command can stop the run.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from bayesrace import clock
from bayesrace.arrays import Floats
from bayesrace.codegen.compiler import compiled
from bayesrace.columns import Columns, columns_of
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.driver import Decision
from bayesrace.controller.interface import Controller, Environment
from bayesrace.controller.settings import CycleSettings
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.log import LogWriter
from bayesrace.messages import (
    ACTUATION,
    EVENT,
    SENSOR_FAULTS,
    STATE,
    TELEMETRY,
    TRUTH,
    Event,
    Message,
    Scalar,
    State,
    Topic,
    car_key,
    encode,
)
from bayesrace.operation.analysis.laps import LapTimes, Trajectory, time_laps
from bayesrace.operation.run_plan import RunPlan, announcement, run_request
from bayesrace.plant.car import CarRun, End, drive_lockstep, truth_behind
from bayesrace.plant.simulator import Simulator
from bayesrace.plant.vehicle import Vehicle
from bayesrace.plant.world import UNCHANGED, World
from bayesrace.raceline import RaceLine
from bayesrace.realtime import uncollected
from bayesrace.sensors import EXACT, Sensors
from bayesrace.tracks import PathProjection, Track
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic

__all__ = ["ClosedLoop", "Driven", "Watch", "built_in_car"]

Watch = Callable[[Sequence[float]], End | None]
"""Sees each true state (7,) of a run, and may end it."""

_EPOCH: Final = 1

_LIMIT: Final = 3.0
"""A run ends at this multiple of the racing line's time ..."""
_LIMIT_S: Final = 2.0
"""... and so much more."""


@dataclass(frozen=True, eq=False)
class Driven(Trajectory):
    """One run: the truth, what was measured of it, and what the controller decided."""

    car: Car
    track: Track
    step_s: float
    states: list[State]
    """As measured, one a sampling period."""
    true_x: list[tuple[float, ...]]
    """The true states (7,) behind them."""
    statuses: NDArray[np.int64]
    """Of the controller's steps, shape (m,); m is n - 1, or n if the car failed or left."""
    levels: NDArray[np.int64]
    """Of the fallback, shape (m,); see :class:`bayesrace.controller.driver.Level`."""
    faults: NDArray[np.int64]
    """What speaks against each state, shape (m,); see :attr:`.fault`."""
    estimates: list[tuple[float, ...]]
    """What was made of the readings (9,), one for each of these states; empty where x counts."""
    step_us: Floats
    """Execution times of the steps that were made, shape (at most m,)."""
    second_starts: int
    """Steps that looked for another plan beside the one that went on from before."""
    end: End
    weights_version: str
    """Of the weights that drove; empty without any."""

    @cached_property
    def moments(self) -> Columns:
        """What was measured, with times, inputs and laps that are true; :attr:`x` is as well."""
        return columns_of(State, self.states, f"{STATES} lap")

    @cached_property
    def x(self) -> Floats:
        """True states, shape (n, 7)."""
        return np.array(self.true_x, dtype=np.float64).reshape(-1, 7)

    @cached_property
    def laps(self) -> LapTimes:
        """Interpolated within the sampling period."""
        return time_laps(self.track, self.time_s, self.x[:, :2], self.projected.s_m)

    @property
    def laps_s(self) -> tuple[float, ...]:
        """Lap times, the first one from standstill."""
        return self.laps.times_s

    @cached_property
    def off_track_m(self) -> Floats:
        """How far off the track the counted samples are: those up to the end of the last lap, or
        all of a run without one. Negative on the track."""
        counted = self.laps.after[-1] if self.laps.after else len(self.x)
        return self.projected.off_track_m[:counted]

    @property
    def fallbacks(self) -> int:
        """Cycles that the fallback drove."""
        return int((self.levels > 0).sum())

    @cached_property
    def projected(self) -> PathProjection:
        """Where the true states are on the track."""
        return self.track.project_path(self.x[:, :2])

    def samples(self) -> Dataset:
        """What can be learned from the measurements, as from the run's log.

        Cycles driven by the fallback, and states that are not believed, are left out. InputError if
        the run ended before its second state.
        """
        answered = self.moments[: len(self.levels)]
        cycles = np.empty(len(answered), [(name, object) for name in CYCLES.split()])
        cycles["run"], cycles["state_seq"] = answered["run"], answered["seq"]
        cycles["fallback"] = self.levels[: len(answered)]
        for i, one in enumerate(self.estimates[: len(answered)]):
            cycles["estimate"][i] = one  # as one value, not as a row of an array
        cycles["sensor_fault"] = [SENSOR_FAULTS[one] for one in self.faults[: len(answered)]]
        return dataset_from_columns(self.moments, cycles, self.car, self.step_s)

    def __str__(self) -> str:
        laps = " ".join(f"{t:.3f}" for t in self.laps_s)
        off = int((self.off_track_m > 0).sum())
        text = f"{laps} s, {off} off track" if laps else f"no lap finished, {off} off track"
        if off:
            text += f" (deepest {1e3 * float(self.off_track_m.max()):.0f} mm)"
        return text + (f", {self.fallbacks} fallbacks" if self.fallbacks else "")


def built_in_car(car: Car, world: World = UNCHANGED) -> Simulator:
    """The car by the built-in equations, compiled; several loops in turn may drive it."""
    return Simulator(dynamic(car), compiled=compiled, world=world)


class ClosedLoop:
    """A car on a track with its controller; each :meth:`drive` is a run from the start line."""

    def __init__(
        self,
        car: Car,
        track: Track,
        line: RaceLine,
        controller: Controller,
        vehicle: Vehicle | None = None,
        log: LogWriter | None = None,
        settings: CycleSettings | None = None,
        sensors: Sensors = EXACT,
        seed: int = 0,
        delay_s: float = 0.0,
    ) -> None:
        """``vehicle``: what plays the car; the built-in equations without. ``log``: gets the
        messages that a race records. ``settings``: of the control cycle. ``sensors`` with the
        ``seed`` of their errors, and ``delay_s`` of states and of actuations each: those of the
        plant process.
        """
        self._car, self._track, self._line = car, track, line
        self._vehicle = vehicle or built_in_car(car)
        self._cycle = Cycle(controller, car, settings or CycleSettings())
        self._controller = controller
        self._log = None if log is None else _Messages(log, car.name)
        self._sensors, self._seed, self._delay_s = sensors, seed, delay_s
        self._run = self._seq = 0
        self._answer = (0.0, 0.0)

    def drive(
        self,
        laps: int = 2,
        max_time_s: float | None = None,
        start_speed_mps: float = 0.1,
        x0: Sequence[float] | None = None,
        name: str = "",
        watch: Watch = lambda _: None,
    ) -> Driven:
        """Drives until the laps are done (0: no limit), the time is up, or ``watch`` of a true
        state (7,) returns an end.

        ``max_time_s``: default as in a race, three times the racing line's time. ``x0``: start
        state (7,) instead of the start line at ``start_speed_mps``. ``name``: of the controller, in
        the log. Raises InputError if the car cannot start there, FmuFault if it fails at that; a
        later fault ends the run.
        """
        if max_time_s is None:
            max_time_s = _LIMIT * self._line.lap_time_s * max(laps, 1) + _LIMIT_S
        self._run, self._watch = self._run + 1, watch
        plan = RunPlan(self._run, name, laps, max_time_s, True, start_speed_mps)
        request = run_request(self._track, plan)
        if x0 is not None:
            request = structs.replace(request, x0=tuple(map(float, x0)))
        played = self._sensors, 2 * self._delay_s, self._seed
        run = CarRun(request, self._vehicle, _EPOCH, *played)
        self._states: list[State] = []
        self._true_x: list[tuple[float, ...]] = []
        self._decided: list[tuple[int, int, int]] = []
        self._estimates: list[tuple[float, ...]] = []
        self._step_us: list[float] = []
        second_starts = self._cycle.driver.count("second_starts")
        if self._log is not None:
            self._log.begins(plan, self._controller.weights_version)
        try:
            with uncollected():
                end = drive_lockstep(run, self._seq, self._exchange)
        finally:
            self._cycle.driver.lost(silent=False)
        if self._log is not None:
            self._log.ends(run, end)
        states, true_x = self._states, self._true_x
        self._seq = states[-1].seq + 1
        if len(states) > 1 and states[-1].time_s == states[-2].time_s:
            states.pop()  # a fault of the plant repeats the last state
            true_x.pop()
        decided = np.array(self._decided, dtype=np.int64).reshape(-1, 3)
        return Driven(
            self._car,
            self._track,
            self._vehicle.step_s,
            states,
            true_x,
            decided[:, 0],
            decided[:, 1],
            decided[:, 2],
            self._estimates,
            np.array(self._step_us),
            self._cycle.driver.count("second_starts") - second_starts,
            end,
            self._controller.weights_version,
        )

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        """Hands the state to the controller; what it answers, or what ends the run."""
        self._states.append(state)
        self._true_x.append(x)
        if self._log is not None:
            self._log.write(STATE, state)
            self._log.write(TRUTH, truth_behind(state, x))
        self._cycle.driver.observe(state)
        if not state.final:
            self._cycle.answer(state, self._send, self._limits(state))
        return self._watch(x) or self._answer

    def _limits(self, state: State) -> Environment | None:
        """What limits the car in this cycle, as the watch of a controller process may: nothing."""
        return None

    def _send(self, state: State, decision: Decision) -> None:
        self._answer = decision.d, decision.delta_rate
        self._decided.append((decision.status, int(decision.level), decision.fault))
        belief = self._cycle.driver.belief
        self._estimates.append(() if belief is None else tuple(belief.x.tolist()))
        if decision.stepped:
            self._step_us.append(decision.step_us)
        if self._log is not None:
            cycle, received_ns = self._cycle, state.source_time_ns
            seq = cycle.timing.ticks
            self._log.write(ACTUATION, cycle.actuation(seq, state, decision))
            self._log.write(TELEMETRY, cycle.telemetry(seq, state, decision, received_ns))


class _Messages:
    """Writes what a race records into a log."""

    def __init__(self, log: LogWriter, car: str) -> None:
        self._log, self._car = log, car
        self._runs = 0

    def write(self, topic: Topic[Any], message: Message, source: str = "") -> None:
        key = car_key(topic.key, self._car, source)
        self._log.write(key, encode(message), message.source_time_ns)

    def begins(self, plan: RunPlan, weights_version: str) -> None:
        self.write(EVENT, announcement(plan, self._runs, weights_version), "race")
        self._event(2 * self._runs, plan.run, "run_started", "in one process", {})

    def ends(self, run: CarRun, end: End) -> None:
        text = f"run {run.request.run} ended after {run.time_s:.2f} s: {end.text}"
        data: dict[str, Scalar] = {"reason": end.reason, "time_s": run.time_s, "laps": run.laps}
        data |= asdict(run.vehicle.guard.counters)
        self._event(2 * self._runs + 1, run.request.run, "run_ended", text, data)
        self._runs += 1

    def _event(self, seq: int, run: int, kind: str, text: str, data: dict[str, Scalar]) -> None:
        event = Event(
            seq=seq,
            source_time_ns=clock.monotonic_ns(),
            run=run,
            source="plant",
            kind=kind,
            text=text[:2000],
            data=data,
        )
        self.write(EVENT, event, "plant")
