"""The car of one run, without transport or clock: start, states, laps, end; and the loop of a
lockstep run.

The plant process exchanges states for inputs over the network; ``bayesrace.operation.closed_loop``
does so by a function call. Both drive the car through :func:`drive_lockstep`, so their runs are
equal to the bit.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from bayesrace import clock
from bayesrace.messages import Reading, RunRequest, State, Truth
from bayesrace.plant.sensors import SensorPlayer
from bayesrace.plant.vehicle import FmuFault, Vehicle
from bayesrace.sensors import EXACT, Sensors
from bayesrace.tracks.track import Crossing, CrossingLine

__all__ = ["CarRun", "End", "LineCounter", "drive_lockstep", "fault_end", "truth_behind"]

_WORLD_M: Final = 1e4


@dataclass(frozen=True, slots=True)
class End:
    """Why a run ended: a word of ``END_REASONS``, and a sentence."""

    reason: str
    text: str


def fault_end(fault: FmuFault) -> End:
    """The end of a run whose car has failed."""
    return End("plant_fault", str(fault))


def truth_behind(state: State, x: tuple[float, ...]) -> Truth:
    """The message of the true state (7,) that ``state`` was measured of."""
    return Truth(
        seq=state.seq,
        source_time_ns=state.source_time_ns,
        epoch=state.epoch,
        run=state.run,
        time_s=state.time_s,
        x=x,
        u_applied=state.u_applied,
        lap=state.lap,
    )


class LineCounter:
    """Counts crossings of a line: forwards plus one, backwards minus one."""

    def __init__(
        self, x_m: float, y_m: float, heading_rad: float, left_m: float, right_m: float
    ) -> None:
        self._line = CrossingLine(x_m, y_m, heading_rad, left_m, right_m)
        self.restart(x_m, y_m)

    def restart(self, x_m: float, y_m: float) -> None:
        """Begin at a position, without a crossing so far."""
        self._at, self._past = (x_m, y_m), self._line.is_past(x_m, y_m)
        self.crossings = 0
        self.newest = Crossing(0, 0.0)
        """The last one, on the way between the two positions that it is between."""

    def move(self, x_m: float, y_m: float) -> int:
        """Crossings so far, after the car moved here."""
        before, was_past = self._at, self._past
        self._at, self._past = (x_m, y_m), self._line.is_past(x_m, y_m)
        if self._past != was_past:
            self.newest = self._line.crossing(before, self._at)
            self.crossings += self.newest.direction
        return self.crossings


class CarRun:
    """The car of one run: reset to its start, sampled, its laps counted, its end found.

    Raises InputError if the car cannot be in the start state, FmuFault if it fails at that.
    """

    def __init__(
        self,
        request: RunRequest,
        vehicle: Vehicle,
        epoch: int,
        sensors: Sensors = EXACT,
        delay_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        """``epoch``: of the plant, as its states carry it. ``seed``: of what ``sensors`` add.

        ``delay_s``: in lockstep, from a state until the input that answers it acts; rounded to
        parts of a period (:attr:`Vehicle.substeps`).
        """
        self.request, self.vehicle = request, vehicle
        self._epoch = epoch
        exact = request.exact or not sensors.root
        self._sensors = None if exact else SensorPlayer(sensors, seed)
        self._delay = round(delay_s / vehicle.step_s * vehicle.substeps)
        self._period = 0
        self._sent: deque[tuple[int, int, tuple[float, ...]]] = deque()
        """From which substep of the run on an input acts, the state it answers, the input."""
        self._held: tuple[float, ...] | None = None
        self._delays: tuple[float, ...] = ()
        self._line = LineCounter(
            request.line_x_m,
            request.line_y_m,
            request.line_heading_rad,
            request.line_left_m,
            request.line_right_m,
        )
        vehicle.reset(request.x0)
        self._line.restart(float(vehicle.x[0]), float(vehicle.x[1]))

    @property
    def laps(self) -> int:
        """Start-line crossings so far."""
        return self._line.crossings

    @property
    def time_s(self) -> float:
        """Plant time since the start."""
        return self.vehicle.time_s

    def sample(
        self, seq: int, actuation_delays: tuple[float, ...] = (), final: bool = False
    ) -> tuple[State, tuple[float, ...]]:
        """What is measured, and the true state (7,); see :func:`truth_behind`."""
        vehicle, request = self.vehicle, self.request
        now_ns, x = clock.monotonic_ns(), tuple(vehicle.x.tolist())
        readings = self._readings(x)
        state = State(
            seq=seq,
            source_time_ns=now_ns,
            epoch=self._epoch,
            run=request.run,
            time_s=vehicle.time_s,
            x=x if readings is None else (0.0,) * len(x),
            u_applied=vehicle.u_applied,
            lap=self._line.crossings,
            lockstep=request.lockstep,
            actuation_delays=actuation_delays or self._delays,
            final=final,
            estimated=readings is not None,
            readings=readings or (),
        )
        return state, x

    def _readings(self, x: tuple[float, ...]) -> tuple[Reading, ...] | None:
        """What instruments report; None: the whole state is measured."""
        if self._sensors is None or self.vehicle.real:
            return self.vehicle.readings()
        return self._sensors.report(self.vehicle.time_s, x)

    def step(self, u: tuple[float, ...], seq: int) -> None:
        """One period of lockstep, from the sample ``seq`` that ``u`` answers. FmuFault."""
        vehicle, begin = self.vehicle, self._period * self.vehicle.substeps
        self._period += 1
        if not self._delay:
            vehicle.step(u)
            return
        self._sent.append((begin + self._delay, seq, u))
        commands: list[tuple[int, tuple[float, ...] | None]] = []
        delay_s = self._delay * vehicle.step_s / vehicle.substeps
        done, self._delays = 0, ()
        while self._sent and (at := self._sent[0][0] - begin) < vehicle.substeps:
            commands.append((at - done, self._held))
            _, answered, self._held = self._sent.popleft()
            self._delays += (float(answered), delay_s, delay_s)
            done = at
        commands.append((vehicle.substeps - done, self._held))
        vehicle.step_switched(commands)

    def finished(self) -> End | None:
        """Counts laps in the state that has just been reached; what ends the run, if anything."""
        x, y = float(self.vehicle.x[0]), float(self.vehicle.x[1])
        if not (abs(x) <= _WORLD_M and abs(y) <= _WORLD_M):
            return End("left_world", f"the car is {_WORLD_M:g} m away or nowhere")
        laps = self._line.move(x, y)
        if 0 < self.request.laps <= laps:
            return End("laps", f"{laps} lap(s) done")
        if self.vehicle.time_s >= self.request.max_time_s:
            return End("max_time", f"time limit of {self.request.max_time_s:g} s reached")
        return None


def drive_lockstep(
    car: CarRun,
    first_seq: int,
    exchange: Callable[[State, tuple[float, ...]], tuple[float, ...] | End],
    beat: Callable[[], End | None] = lambda: None,
) -> End:
    """Drives in lockstep until something ends the run.

    ``exchange`` hands over a state, numbered from ``first_seq`` on, with the true state (7,) behind
    it, and returns the input (2,) that answers it, or what ends the run; nothing answers a final
    state. ``beat`` is called once a period; what it returns, if anything, ends the run, too.
    """
    seq = first_seq
    end: End | None = None
    while True:
        answer = exchange(*car.sample(seq, final=end is not None))
        if end is not None:
            return end
        if isinstance(answer, End):
            return answer
        seq += 1
        if (end := beat()) is not None:
            continue
        try:
            car.step(answer, seq - 1)
        except FmuFault as fault:
            end = fault_end(fault)  # the state before is the last there is: once more, as final
            continue
        end = car.finished()
        if end is not None and end.reason == "left_world":
            return end  # no message could carry this state
