"""The messages: immutable, typed, each field with its rule.

Clocks: ``source_time_ns`` is the sender's ``time.monotonic_ns()``; it is comparable only between
processes of one machine. ``time_s`` is the plant's own time since the start of the run, and the
only time in which the plant and its controller speak to each other of delays.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Final

from bayesrace.messages.rules import (
    Choice,
    Flag,
    Integer,
    Real,
    Scalar,
    Scalars,
    Text,
    Vector,
)

__all__ = [
    "END_REASONS",
    "PHASES",
    "Actuation",
    "CarSample",
    "ClockReading",
    "ClockRequest",
    "Command",
    "Event",
    "Message",
    "Reply",
    "RollbackRequest",
    "RunRequest",
    "State",
    "Status",
    "StatusRequest",
    "StopRequest",
    "Telemetry",
    "Truth",
]

END_REASONS: Final = (
    "laps", "max_time", "stopped", "controller_lost", "actuation_timeout", "left_world",
    "interrupted", "plant_fault", "abandoned", "several_controllers",
)  # fmt: skip
"""Why a run ended, in the ``kind="run_ended"`` event's data under ``reason``; plant_fault: what
plays the car has failed, and its last good state is sent once more as the final one; abandoned: who
started it has been gone for long; several_controllers: at its regular end more than one was there,
so that the actuations of the run cannot be attributed."""

PHASES: Final = ("idle", "running", "waiting", "ready", "driving", "fallback", "stopped")
"""Of a process, see :class:`Status`."""

Count = Annotated[int, Integer()]
Signed = Annotated[int, Integer(-(2**31), 2**31 - 1)]
Seconds = Annotated[float, Real(0.0, 1e9)]
Metre = Annotated[float, Real(-1e6, 1e6)]
Width = Annotated[float, Real(0.0, 1e3)]
Duration = Annotated[float, Real(0.0, 1e9)]
Short = Annotated[str, Text(200)]
Long = Annotated[str, Text(2000)]
DataMap = Annotated[Mapping[str, Scalar], Scalars()]

_CAR_STATE: Final = ("x", "y", "psi", "vx", "vy", "omega", "delta")
_INPUT: Final = ("d", "delta_rate")
CarState = Annotated[tuple[float, ...], Vector(7, names=_CAR_STATE)]
Input = Annotated[tuple[float, ...], Vector(2, names=_INPUT)]


@dataclass(frozen=True, slots=True)
class Message:
    """What every message starts with."""

    SCHEMA: ClassVar[int] = 1
    """Version of the message's fields; a reader refuses any other."""

    seq: Count
    """Number of this message among those of its sender on its key, from 0, without gaps."""
    source_time_ns: Count
    """Sender's monotonic clock when the message was made [ns]."""


@dataclass(frozen=True, slots=True)
class CarSample(Message):
    """The car at one moment, as measured or in truth; ``source_time_ns`` is that moment."""

    epoch: Count
    """Random number of the plant's process: what answers another one's states is not for this one,
    however its numbers look."""
    run: Count
    """Number of the run, from its request; it separates one run's messages from the next one's."""
    time_s: Seconds
    """Plant time since the start of the run."""
    x: CarState
    """x, y [m], psi [rad, unwrapped], vx, vy [m/s], omega [rad/s], delta [rad]."""
    u_applied: Input
    """d [-] and delta_rate [rad/s] that acted during the period before; zeros at the start."""
    lap: Signed
    """Start-line crossings so far, forwards minus backwards."""


@dataclass(frozen=True, slots=True)
class State(CarSample):
    """What the sensors measure, and all that controller and learning know of the car:
    ``bayesrace/{car}/state``."""

    lockstep: Annotated[bool, Flag()]
    """True if the plant waits for the actuation that answers this very message."""
    answers: Annotated[
        tuple[float, ...],
        Vector(3, limit=1e15, rows=64, names=("state_seq", "arrival_s", "acting_s")),
    ]
    """What was received since the state before, row by row: number of the state answered, time
    from that state to the arrival of the answer [s], and from the answer's ``basis_s`` to its
    acting [s] (-1: overtaken, it never acts). Empty in lockstep."""
    final: Annotated[bool, Flag()]
    """True in the last state of a run: nothing that answers it will act. After a fault of the plant
    it repeats the state before, time included."""


@dataclass(frozen=True, slots=True)
class Truth(CarSample):
    """What the sensors of the :class:`State` with the same ``seq`` were to measure, for the log and
    for who judges a drive: ``bayesrace/{car}/truth``. A real car sends none."""


@dataclass(frozen=True, slots=True)
class Actuation(Message):
    """The controller's answer to one state: ``bayesrace/{car}/actuation``."""

    epoch: Count
    run: Count
    state_seq: Count
    """``seq`` of the state that this answers; with epoch and run as in that state."""
    basis_s: Seconds
    """Plant time up to which the controller took the car's state as known: ``time_s`` of the state,
    plus what had passed since its arrival if it is not a new one."""
    u: Annotated[tuple[float, ...], Vector(2, limit=1e3, names=_INPUT)]
    """d [-], delta_rate [rad/s]; the range here is sanity, the car's limits are the plant's."""
    weights_version: Short
    """Version of the residual's weights that made it; empty without any."""
    status: Annotated[int, Integer(0, 255)]
    """The controller's status code of this step; 0 is good."""


@dataclass(frozen=True, slots=True)
class Telemetry(Message):
    """How the actuation came about: ``bayesrace/{car}/telemetry``."""

    SCHEMA: ClassVar[int] = 2

    run: Count
    state_seq: Count
    status: Annotated[int, Integer(0, 255)]
    fallback: Annotated[int, Integer(0, 9)]
    """0 solution, 1 shifted previous plan, 2 braking along the last safe steering, 3 stop."""
    iterations: Annotated[int, Integer(0, 100_000)]
    tick: Count
    """Number of the cycle since the process started; what is missing among them was skipped."""
    released_ns: Count
    """Monotonic clock when the cycle began, the state at hand."""
    received_ns: Count
    """Monotonic clock when the state answered was taken from the network."""
    missed: Annotated[bool, Flag()]
    """The actuation was on its way only after the deadline, the next release."""
    wake_us: Duration
    """How late the loop woke from its sleep before this cycle (the rest also in us); 0 in
    lockstep."""
    decode_us: Duration
    prepare_us: Duration
    """Preparation phase of the step, done after the cycle before."""
    solve_us: Duration
    """Feedback phase: execution time of the controller's step."""
    encode_us: Duration
    """Making and sending the actuation."""
    delay_s: Annotated[float, Real(0.0, 1e3)]
    """Delay from ``basis_s`` to acting that the prediction of the state covers; 0 without."""
    plan_x: Annotated[tuple[float, ...], Vector(7, rows=501, names=_CAR_STATE)]
    """Predicted states row by row, N + 1 rows of 7; empty without a prediction."""
    plan_u: Annotated[tuple[float, ...], Vector(2, rows=500, names=_INPUT)]
    """Planned inputs row by row, N rows of 2."""
    residual_dynamics: Annotated[float, Real(-1.0, 1e12)]
    """Largest dynamics defect of the plan; -1 if not known or not finite (the others as well)."""
    residual_bounds: Annotated[float, Real(-1.0, 1e12)]
    """Largest violation of a bound."""
    residual_stationarity: Annotated[float, Real(-1.0, 1e12)]
    """Norm of the gradient of the Lagrangian."""
    cost: Annotated[float, Real(-1.0, 1e12)]
    """Objective of the plan; -1 without."""
    cost_shifted: Annotated[float, Real(-1.0, 1e12)]
    """Of the plan before, shifted, for the same state and reference; -1 without: a plan that costs
    much more has jumped to another local minimum."""
    second_start: Annotated[int, Integer(0, 2)]
    """1: the plan before was doubtful, and a plan from anew no better; 2: that one is used."""
    s_ref_m: Annotated[float, Real(-1e6, 1e6)]
    """Arc length of the reference point on the racing line."""
    n_ref_m: Annotated[float, Real(-1e6, 1e6)]
    """Lateral offset from the racing line, positive to the left."""


@dataclass(frozen=True, slots=True)
class Event(Message):
    """Something happened that a person may want to know: ``bayesrace/{car}/event/{source}``."""

    run: Count
    source: Annotated[str, Choice(("plant", "controller", "race", "recorder"))]
    kind: Short
    text: Long
    data: DataMap


@dataclass(frozen=True, slots=True)
class RunRequest(Message):
    """Start a run: asked of ``bayesrace/{car}/plant/run``; the answer is a :class:`Reply`."""

    run: Count
    lockstep: Annotated[bool, Flag()]
    """True: the plant advances only on the matching actuation; False: by the wall clock."""
    x0: CarState
    """Start state, as in :class:`State`."""
    line_x_m: Metre
    line_y_m: Metre
    line_heading_rad: Annotated[float, Real(-1e3, 1e3)]
    """Direction of driving across the start line."""
    line_left_m: Width
    line_right_m: Width
    """Reach of the start line from its point to each side, margin included."""
    laps: Annotated[int, Integer(0, 100_000)]
    """The run ends at this many crossings; 0 is without end."""
    max_time_s: Annotated[float, Real(0.0, 1e6)]
    actuation_timeout_s: Annotated[float, Real(0.001, 600.0)]
    """Lockstep: how long to wait for an answer before the run ends. Free-running: older than this,
    an actuation no longer acts and the plant brakes."""


@dataclass(frozen=True, slots=True)
class StopRequest(Message):
    """End the run that is under way: asked of ``bayesrace/{car}/plant/stop``."""

    text: Long
    """Why; it comes back in the end-of-run event."""


@dataclass(frozen=True, slots=True)
class StatusRequest(Message):
    """Asked of ``bayesrace/{car}/plant/status`` and ``…/controller/status``."""


@dataclass(frozen=True, slots=True)
class RollbackRequest(Message):
    """Go back to the weights before those in use: asked of ``bayesrace/{car}/controller/rollback``;
    the answer is a :class:`Reply`."""

    text: Long
    """Why; it comes back in the event."""


@dataclass(frozen=True, slots=True)
class Command(Message):
    """Told to ``bayesrace/{car}/controller/command``; the answer is a :class:`Reply`."""

    command: Annotated[str, Choice(("stop", "go"))]
    """stop: brake to standstill and stay there; go: drive (again)."""
    text: Long
    """Why; it comes back in the controller's status."""


@dataclass(frozen=True, slots=True)
class ClockRequest(Message):
    """Asked of ``bayesrace/{car}/plant/clock`` and ``…/controller/clock``."""


@dataclass(frozen=True, slots=True)
class ClockReading(Message):
    """The clock of a process, ``source_time_ns``, read between request and answer."""

    host: Short
    """Of the process; for people."""


@dataclass(frozen=True, slots=True)
class Reply(Message):
    """Answer to a request that changes something."""

    accepted: Annotated[bool, Flag()]
    text: Long
    """Why not, or what now."""
    data: DataMap


@dataclass(frozen=True, slots=True)
class Status(Message):
    """State of a process: ``bayesrace/{car}/status/{source}`` at 10 Hz, and answered on request."""

    source: Annotated[str, Choice(("plant", "controller"))]
    phase: Annotated[str, Choice(PHASES)]
    """plant: idle, running; controller: waiting (for a state), ready (for a go), driving, fallback,
    stopped (on command)."""
    epoch: Count
    """The plant's, or that of the plant the controller follows; 0 without."""
    run: Count
    text: Long
    """The last thing worth saying, such as why the last run ended."""
    weights_version: Short
    rate_hz: Annotated[float, Real(0.0, 1e5)]
    """Of the loop, as set; 0 in lockstep."""
    state_age_s: Annotated[float, Real(-1.0, 1e9)]
    """Since the newest state was received (controller) or sent (plant); -1: none yet."""
    delay_s: Annotated[float, Real(0.0, 1e3)]
    """Controller: delay that it measures and predicts over; plant: the one it was told to add."""
    counters: DataMap
    """Everything counted since the process started."""
