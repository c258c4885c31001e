"""The message types: immutable structures of msgspec, each field with its type and its limits.

Numbers have a range, which NaN is never in; texts, arrays and maps have a largest length. The
``tag`` of a class is its schema version.

Clocks: ``source_time_ns`` is the sender's ``time.monotonic_ns()``, comparable only between
processes of one machine. ``time_s`` is plant time, which starts with the run; plant and controller
express all delays in it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

from msgspec import Meta, Struct

__all__ = [
    "BRAKING_ROWS", "END_REASONS", "ESTIMATED", "MOST_INSTRUMENTS", "MOST_READINGS",
    "NOT_REPORTED", "PHASES", "QUANTITIES", "SENSOR_FAULTS", "Actuation", "BrakingPlan",
    "CarSample", "Command", "Event", "GoOnRequest", "Hold", "Message", "Reading", "Reply",
    "RollbackRequest", "RunRequest", "Scalar", "State", "Status", "StatusRequest", "StopRequest",
    "Telemetry", "Truth",
]  # fmt: skip

END_REASONS: Final = (
    "laps", "max_time", "stopped", "controller_lost", "actuation_timeout", "left_world",
    "interrupted", "plant_fault", "abandoned", "several_controllers", "hold_lost",
)  # fmt: skip
"""Why a run ended: ``reason`` in the data of the ``run_ended`` event.

plant_fault: the simulated car failed, and its last good state is repeated as the final one.
abandoned: the client that started the run was away for too long, or left it waiting in a pause.
several_controllers: at its regular end the run had more than one controller, so its actuations
cannot be attributed.
hold_lost: the plant stopped the car, because the director of the held run was missing."""

PHASES: Final = ("idle", "running", "waiting", "ready", "driving", "fallback", "stopped")
"""Phases of a process, see :class:`Status`."""

SENSOR_FAULTS: Final = (
    "", "frozen", "time", "position", "heading", "velocity", "yaw_rate", "steering", "elsewhere",
    "uncertain",
)  # fmt: skip
"""What can speak against a measured state, in the order of br_fault in
controller/native/bayesrace_cycle.h, which says what each means."""

BRAKING_ROWS: Final = 192
"""BR_BRAKING_ROWS there."""


def _one_of(words: Sequence[str]) -> Meta:
    """Limits a text to one of these words."""
    # Not Literal, which cannot be computed and whose refusal does not name the words.
    # In Python, $ alone would match before a line break at the end, too.
    pattern = rf"^(?:{'|'.join(words)})(?!\n)$"
    return Meta(pattern=pattern, extra_json_schema={"enum": list(words)})


def _vector(*names: str, rows: int | None = None) -> Meta:
    """Limits an array to one number for each name, or to ``rows`` rows of them, row by row.

    The names are those of the numbers in JSON. ``__post_init__`` checks that rows are whole.
    """
    least = None if rows else len(names)
    return Meta(min_length=least, max_length=len(names) * (rows or 1), extra={"names": names})


Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Signed = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
Calendar = Annotated[float, Meta(ge=0.0, le=1e11)]
Delay = Annotated[float, Meta(ge=0.0, le=1e3)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Width = Annotated[float, Meta(ge=0.0, le=1e3)]
Refusals = Annotated[tuple[Annotated[int, Meta(ge=0, le=1_000_000)], ...], Meta(max_length=16)]
Measure = Annotated[float, Meta(ge=-1.0, le=1e12)]
Short = Annotated[str, Meta(max_length=200)]
Long = Annotated[str, Meta(max_length=2000)]
StatusCode = Annotated[int, Meta(ge=0, le=255)]

Scalar = (
    bool
    | Annotated[int, Meta(ge=1 - 2**63, le=2**63 - 1)]
    | Annotated[float, Meta(ge=-1e12, le=1e12)]
    | Long
)
"""Value in the data map of an event or a reply."""
DataMap = Annotated[
    Mapping[Annotated[str, Meta(max_length=100)], Scalar],
    Meta(max_length=200, extra_json_schema={"properties": {}}),
]

QUANTITIES: Final = ("x", "y", "psi", "vx", "vy", "omega", "delta")
"""What can be measured of a car: its states."""

MOST_INSTRUMENTS: Final = 8
"""Of one car: BR_INSTRUMENTS in controller/native/bayesrace_estimator.h."""

MOST_READINGS: Final = 16
"""In one state: BR_MEASUREMENTS in controller/native/bayesrace_cycle.h."""

ESTIMATED: Final = (*QUANTITIES, "gyro_offset", "steering_offset")
"""What is estimated of a car: these, then the offsets of the measured yaw rate and steering angle
[rad/s, rad]."""

_INPUT: Final = ("d", "delta_rate")
_DELAYS: Final = ("state_seq", "arrival_s", "acting_s")
CarState = Annotated[tuple[Number, ...], _vector(*QUANTITIES)]
Input = Annotated[tuple[Number, ...], _vector(*_INPUT)]


class Message(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="schema", tag=1
):
    """The fields that every message starts with.

    msgspec writes the schema version before them, and refuses any other than the class's.
    """

    seq: Count
    """Number of the message, counted by its sender for each key, from 0 without gaps."""
    source_time_ns: Count
    """Sender's monotonic clock when the message was made [ns]."""


class CarSample(Message, frozen=True, kw_only=True):
    """The car at one moment, measured or true; ``source_time_ns`` is that moment."""

    epoch: Count
    """Random number of the plant's process; actuations with another epoch answer another plant."""
    run: Count
    """Number of the run, from its request; it separates the messages of consecutive runs."""
    time_s: Seconds
    """Plant time since the start of the run."""
    x: CarState
    """x, y [m], psi [rad, unwrapped], vx, vy [m/s], omega [rad/s], delta [rad]."""
    u_applied: Input
    """d [command] and delta_rate [rad/s] applied during the previous period; zeros at the start."""
    lap: Signed
    """Start-line crossings so far, forwards minus backwards."""


_Quantity = Annotated[str, _one_of(QUANTITIES)]
_Measured = tuple[Number, Annotated[float, Meta(ge=1e-12, le=1e6)]]
_MEASURED: Final = {
    "type": "array", "items": {"type": "number", "minimum": -1e6, "maximum": 1e6},
    "minItems": 2, "maxItems": 2,
}  # fmt: skip


class Reading(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one instrument has measured at one moment."""

    instrument: Annotated[str, Meta(max_length=40)]
    """Its name."""
    time_s: Annotated[float, Meta(ge=-1e9, le=1e9)]
    """Plant time of the measurement, which may be reported late."""
    values: Annotated[
        Mapping[_Quantity, _Measured],
        Meta(
            min_length=1, max_length=len(QUANTITIES),
            extra_json_schema={"properties": dict.fromkeys(QUANTITIES, _MEASURED)},
        ),
    ]  # fmt: skip
    """By what it has measured: the value, which for a heading may be off by whole turns, and its
    standard deviation; the errors are independent."""


class State(CarSample, frozen=True, kw_only=True, tag=3):
    """What is measured of the car, on ``bayesrace/{car}/state``.

    The only input of controller and learning.
    """

    estimated: bool
    """True: the state is to be estimated of ``readings``, and ``x`` says nothing; False: ``x`` is
    measured, and the readings are nothing to drive by."""
    readings: Annotated[tuple[Reading, ...], Meta(max_length=MOST_READINGS)]
    """What instruments have reported since the state before."""
    lockstep: bool
    """True if the plant waits for the actuation that answers this very message."""
    actuation_delays: Annotated[
        tuple[Annotated[float, Meta(ge=-1e15, le=1e15)], ...], _vector(*_DELAYS, rows=64)
    ]
    """Delays of the actuations received since the previous state, row by row: ``seq`` of the state
    that each answers, time from that state to the actuation's arrival [s], and from its
    ``decided_at_s`` to its application [s] (-1: superseded, never applied). Empty in lockstep."""
    final: bool
    """True in the last state of a run: no answer to it is applied. After a fault of the plant it
    repeats the previous state with its time."""

    def __post_init__(self) -> None:
        if len(self.actuation_delays) % len(_DELAYS):
            raise ValueError("actuation_delays: not whole rows of 3")


class Truth(CarSample, frozen=True, kw_only=True):
    """True state behind the :class:`State` of the same ``seq``, on ``bayesrace/{car}/truth``.

    For logs and evaluation; a real car sends none.
    """


class Actuation(Message, frozen=True, kw_only=True, tag=2):
    """The controller's answer to one state, on ``bayesrace/{car}/actuation``."""

    epoch: Count
    run: Count
    state_seq: Count
    """``seq`` of the state answered; epoch and run are those of that state."""
    decided_at_s: Seconds
    """Plant time at which the controller decided on the input: in lockstep ``time_s`` of the state;
    in real time the controller's estimate, from the arrival times of the states, of the plant time
    when its cycle began."""
    u: Annotated[tuple[Annotated[float, Meta(ge=-1e3, le=1e3)], ...], _vector(*_INPUT)]
    """d [command], delta_rate [rad/s]; the plant applies the car's own, narrower limits."""
    weights_version: Short
    """Version of the GP weights in use; empty without any."""
    status: StatusCode
    """Status code of the controller's step; 0: converged."""


class Telemetry(Message, frozen=True, kw_only=True, tag=6):
    """Plan, residuals and timing of one control cycle, on ``bayesrace/{car}/telemetry``."""

    run: Count
    state_seq: Count
    status: StatusCode
    fallback: Annotated[int, Meta(ge=0, le=9)]
    """0 solution, 1 shifted previous plan, 2 braking along the line, 3 stop."""
    iterations: Annotated[int, Meta(ge=0, le=100_000)]
    tick: Count
    """Number of the cycle's release since the process started; missing numbers are releases passed
    over. A late cycle, which answers a state that came after its window, has that of the cycle
    before it."""
    released_ns: Count
    """Monotonic clock when the cycle began, with its state received."""
    received_ns: Count
    """Monotonic clock when the control thread received the state."""
    missed: bool
    """The actuation was sent after the deadline, the next release."""
    wake_us: Seconds
    """Wake-up error before this cycle [us, as all below]; 0 in lockstep and of a late cycle."""
    decode_us: Seconds
    prepare_us: Seconds
    """Preparation phase of the step, executed after the previous cycle; 0 of a late cycle, which
    has none."""
    solve_us: Seconds
    """Feedback phase: execution time of the controller's step."""
    encode_us: Seconds
    """Encoding and sending the actuation."""
    delay_s: Delay
    """Delay from ``Actuation.decided_at_s`` to application, over which the state is predicted; 0
    without."""
    plan_x: Annotated[tuple[Number, ...], _vector(*QUANTITIES, rows=501)]
    """Predicted states row by row, N + 1 rows of 7, to 1e-6; empty without a prediction."""
    plan_u: Annotated[tuple[Number, ...], _vector(*_INPUT, rows=500)]
    """Planned inputs row by row, N rows of 2, to 1e-6."""
    tube_m: Annotated[tuple[Number, ...], Meta(max_length=500)]
    """By how much the car may be off to either side at the plan's stages 1 to N, at the probability
    that the controller is set to, because its model is uncertain; empty without a prediction."""
    pace: Annotated[float, Meta(ge=0.0, le=1.0)]
    """Speed of the reference as a share of the racing line's; below 1 where the model is too
    uncertain about the plan."""
    widening: Annotated[float, Meta(ge=0.0, le=1e6)]
    """Factor on the model's standard deviations by what is not known of its mismatch, which is
    estimated from its one-step errors; the largest along the plan, 1 where nothing is lacking."""
    residual_dynamics: Measure
    """Largest dynamics defect of the plan; -1: unknown or not finite (as below)."""
    residual_bounds: Measure
    """Largest violation of a bound."""
    residual_stationarity: Measure
    """Norm of the gradient of the Lagrangian."""
    cost: Measure
    """Objective of the plan."""
    cost_shifted: Measure
    """Objective of the shifted previous plan for the same state and reference; a plan that costs
    much more has jumped to another local minimum."""
    second_start: Annotated[int, Meta(ge=0, le=3)]
    """1: the previous plan was doubtful, and a second start gave no better one; 2: the plan of the
    second start is used; 3: the slow car creeps along its line, or is led round, as no start has
    led to a plan, or as it has stood for too long."""
    s_ref_m: Number
    """Arc length of the reference point on the racing line."""
    n_ref_m: Number
    """Lateral offset from the racing line, positive to the left."""
    sensor_fault: Annotated[str, _one_of(SENSOR_FAULTS)]
    """What speaks against the measured state, in whose place the model's prediction counts; empty:
    nothing (:data:`SENSOR_FAULTS`)."""
    estimate: Annotated[tuple[Number, ...], _vector(*ESTIMATED, rows=1)]
    """What has been made of the readings, at the time of the state (:data:`ESTIMATED`); empty: the
    state was measured as a whole, or nothing is known yet."""
    deviation: Annotated[tuple[Number, ...], _vector(*ESTIMATED, rows=1)]
    """Standard deviations of the estimate."""
    states: Annotated[int, Meta(ge=-1, le=1_000_000)] = -1
    """States that the controller has taken since the cycle before; -1: not reported (as all below
    in recordings of earlier releases)."""
    late_s: Seconds = 0.0
    """How much later than its budget the decision was made."""
    refused: Refusals = ()
    """Where the step's budget ran out: the numbers of the step's questions whether there is time
    left that were answered no (br_mpc_get_refusals in controller/native/bayesrace_mpc.h)."""
    prepared_s: Annotated[float, Meta(ge=-1.0, le=1e6)] = -1.0
    """In how long the preparation before this cycle expected it; 0: there was none; -1: not
    reported."""
    prepared_refused: Refusals = ()
    """Where the preparation's budget ran out, as ``refused``."""

    def __post_init__(self) -> None:
        if len(self.plan_x) % len(QUANTITIES) or len(self.plan_u) % len(_INPUT):
            raise ValueError("plan_x, plan_u: not whole rows of 7, 2")
        if len(self.estimate) % len(ESTIMATED) or len(self.deviation) % len(ESTIMATED):
            raise ValueError(f"estimate, deviation: not {len(ESTIMATED)} numbers")


NOT_REPORTED: Final[Mapping[str, float]] = {
    "iterations": 0, "pace": 1.0, "widening": 1.0, "residual_dynamics": -1.0,
    "residual_bounds": -1.0, "residual_stationarity": -1.0, "cost": -1.0, "cost_shifted": -1.0,
    "s_ref_m": 0.0, "n_ref_m": 0.0,
}  # fmt: skip
"""Numbers of :class:`Telemetry` that a step reports, as they are where there is no such report."""


class BrakingPlan(Message, frozen=True, kw_only=True):
    """What the car's guard does if no actuation comes any more, on ``bayesrace/{car}/braking``: the
    newest input, the plan for as long as the controller would drive on it, then braking along the
    line to standstill. In real time only."""

    epoch: Count
    run: Count
    begins_s: Seconds
    """Plant time from which the first row acts."""
    step_s: Annotated[float, Meta(ge=1e-3, le=1.0)]
    """Time from one row to the next."""
    d: Annotated[tuple[Number, ...], Meta(max_length=BRAKING_ROWS)]
    """Drive command of each row."""
    delta: Annotated[tuple[Number, ...], Meta(max_length=BRAKING_ROWS)]
    """Steering angle at the end of each row [rad]."""


class Event(Message, frozen=True, kw_only=True):
    """An occurrence for operators and logs, on ``bayesrace/{car}/event/{source}``."""

    run: Count
    source: Annotated[str, _one_of(("plant", "controller", "race", "recorder"))]
    kind: Short
    text: Long
    data: DataMap


class Hold(Message, frozen=True, kw_only=True):
    """Heartbeat of a held run's director, on ``bayesrace/{car}/hold``: without it the car stops."""

    epoch: Count
    run: Count
    """Of the run, as in its states."""


class RunRequest(Message, frozen=True, kw_only=True, tag=4):
    """Request on ``bayesrace/{car}/plant/run`` to start a run; the answer is a :class:`Reply`."""

    run: Count
    lockstep: bool
    """True: the plant advances only on the matching actuation; False: in real time."""
    x0: CarState
    """Start state, as in :class:`State`."""
    line_x_m: Number
    line_y_m: Number
    line_heading_rad: Annotated[float, Meta(ge=-1e3, le=1e3)]
    """Direction of driving across the start line."""
    line_left_m: Width
    line_right_m: Width
    """Length of the start line from its point to each side, margin included."""
    laps: Annotated[int, Meta(ge=0, le=100_000)]
    """The run ends at this many crossings; 0: no limit."""
    max_time_s: Annotated[float, Meta(ge=0.0, le=1e6)]
    actuation_timeout_s: Annotated[float, Meta(ge=0.001, le=600.0)]
    """Lockstep: the run ends after so long without an answer. Free-running: the plant brakes when
    its newest actuation is older."""
    held: bool
    """In real time: the car stops when the director's :class:`Hold` is missing."""
    exact: bool
    """States of a simulated car are measured as a whole, as BestCase knows them, whatever its
    sensors."""
    pause_s: Annotated[float, Meta(ge=0.0, le=1e6)]
    """In lockstep: after each such time the plant reports a ``pause`` event and waits for
    :class:`GoOnRequest`. 0: never."""


class StopRequest(Message, frozen=True, kw_only=True):
    """Request on ``bayesrace/{car}/plant/stop`` to end the current run."""

    text: Long
    """The reason, for the ``run_ended`` event."""


class GoOnRequest(Message, frozen=True, kw_only=True):
    """Request on ``bayesrace/{car}/plant/go_on`` to end the pause of a lockstep run; the answer is
    a :class:`Reply`."""

    run: Count
    """That waits."""


class StatusRequest(Message, frozen=True, kw_only=True):
    """Request on ``bayesrace/{car}/{source}/status`` for the :class:`Status` of a process."""


class RollbackRequest(Message, frozen=True, kw_only=True):
    """Request on ``bayesrace/{car}/controller/rollback`` to restore the previous weights.

    The answer is a :class:`Reply`.
    """

    text: Long
    """The reason, for the event."""


class Command(Message, frozen=True, kw_only=True):
    """Request on ``bayesrace/{car}/controller/command``; the answer is a :class:`Reply`."""

    command: Annotated[str, _one_of(("stop", "go"))]
    """stop: brake to standstill and stay there; go: drive (again)."""
    text: Long
    """The reason, for the controller's status."""


class Reply(Message, frozen=True, kw_only=True):
    """Answer to a request that changes the state of a process."""

    accepted: bool
    text: Long
    """The reason of a refusal, or what follows."""
    data: DataMap


class Status(Message, frozen=True, kw_only=True, tag=3):
    """State of a process, on ``bayesrace/{car}/status/{source}`` at 10 Hz and on request."""

    source: Annotated[str, _one_of(("plant", "controller"))]
    phase: Annotated[str, _one_of(PHASES)]
    """plant: idle, running; controller: waiting (for a state), ready (for ``go``), driving,
    fallback, stopped (on command)."""
    epoch: Count
    """Epoch of the plant, or of the plant that the controller follows; 0: none."""
    run: Count
    text: Long
    """The latest message for operators, such as why the last run ended."""
    weights_version: Short
    track: Short
    """Controller: :attr:`bayesrace.tracks.Track.identity` of the track that it drives; empty: a
    plant, or a control law that names none."""
    rate_hz: Annotated[float, Meta(ge=0.0, le=1e5)]
    """Set rate of the loop; 0 in lockstep."""
    state_age_s: Annotated[float, Meta(ge=-1.0, le=1e9)]
    """Time since the newest state was received (controller) or sent (plant); -1: none yet."""
    delay_s: Delay
    """Controller: the measured delay, which it predicts over; plant: the delay set to be added."""
    counters: DataMap
    """All counters since the process started."""
    node: Short
    """Id of the process's session."""
    listens: Annotated[tuple[Short, ...], Meta(max_length=8)]
    """Endpoints that it listens on, as it was started with them, ..."""
    connects: Annotated[tuple[Short, ...], Meta(max_length=8)]
    """... and those that it connects to."""
    seen: Annotated[
        Mapping[Annotated[str, Meta(max_length=40)], Short],
        Meta(max_length=16, extra_json_schema={"properties": {}}),
    ]
    """Plant: the controllers of its car that it sees; controller: the plants. Id of the session to
    the other end of its link, and the name in the certificate there, if it has one."""
    calendar_s: Calendar
    """Calendar time of its machine [s since 1970]."""
