"""From states to inputs: the control cycle in C (controller/native/br_cycle.c) and its results.

The process around it knows messages and clocks; the cycle knows what is to be driven: which states
count, stop and go, delay compensation, the step, the fallback. Times are the plant's unless they
say otherwise, so lockstep and free-running mode are the same here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, Final

from bayesrace import clock
from bayesrace.controller.estimator import Belief, Measurement, fill, read
from bayesrace.controller.interface import Controller, Environment, StepOutput
from bayesrace.controller.native_step import Status
from bayesrace.controller.settings import CycleSettings, MpcSettings
from bayesrace.messages import (
    MOST_INSTRUMENTS,
    QUANTITIES,
    SENSOR_FAULTS,
    BrakingPlan,
    Numbering,
    Reading,
    State,
)
from bayesrace.vehicles.parameters import Car

__all__ = [
    "Decision",
    "Driver",
    "Level",
    "Phase",
]


class Level(IntEnum):
    """Where the input came from; see controller/native/br_fallback.c."""

    SOLUTION = 0
    """Of this step."""
    SHIFTED_PLAN = 1
    """The plan of a step before, driven on."""
    BRAKE = 2
    """Braking along the line."""
    STOP = 3
    """Standing still."""


class Phase(StrEnum):
    """Life cycle of a controller, in the order of br_phase in bayesrace_cycle.h."""

    WAITING = "waiting"
    READY = "ready"
    DRIVING = "driving"
    FALLBACK = "fallback"
    STOPPED = "stopped"


_PHASES, _LEVELS = tuple(Phase), tuple(Level)
_INDEX: Final = {name: i for i, name in enumerate(QUANTITIES)}
_VX: Final = _INDEX["vx"]


@dataclass(slots=True)
class Decision:
    """What one cycle sends; overwritten by the next."""

    d: float = 0.0
    delta_rate: float = 0.0
    level: Level = Level.STOP
    status: int = Status.HALTED
    decided_at_s: float = 0.0
    """Plant time at which the cycle began, as of :class:`Actuation`."""
    delay_s: float = 0.0
    """Prediction from there to the moment of acting."""
    step_us: float = 0.0
    """Execution time of the step."""
    fault: int = 0
    """What speaks against the state: a number of :data:`bayesrace.messages.SENSOR_FAULTS`."""
    late_s: float = 0.0
    """How much later than its budget it was made; not above 0: in time."""
    refused: tuple[int, ...] = ()
    """Where the step's time ran out: :attr:`Driver.refusals`."""
    stepped: bool = False
    """Whether a step was made; :attr:`Driver.output` has its results."""


class Driver:
    """Drives one car with one controller; for one thread."""

    def __init__(self, controller: Controller, car: Car, settings: CycleSettings) -> None:
        """``car``: whose limits hold. InputError if the controller's artefact drives no car."""
        self.controller = controller
        artefact = controller.artefact
        artefact.check_cycle()
        library = self._library = artefact.library
        ffi, size = artefact.ffi, library.br_cycle_memory_size()
        self._memory, made = artefact.memory(size), ffi.new("br_cycle **")
        error = controller.begin_cycle(self._memory, size, settings.hold, made)
        artefact.check(error, "control cycle")
        self._cycle = made[0]
        rate = car.delta_rate_max_radps
        limits = {"u_low": (car.d_min, -rate), "u_high": (car.d_max, rate)}
        driving = ffi.new("br_driving *", settings.cycle_values(car) | limits)
        artefact.check(library.br_cycle_set_driving(self._cycle, driving), "cycle settings")
        library.br_cycle_set_clock(
            self._cycle, ffi.addressof(library, "br_mpc_monotonic"), ffi.NULL
        )
        self._counters = library.br_cycle_counters(self._cycle)
        self._measured = ffi.new("br_measured *")
        self._measured.averaged = 1
        self._decided, self._braking = ffi.new("br_decision *"), ffi.new("br_braking *")
        self._around, self._null = ffi.new("br_environment *"), ffi.NULL
        self._believed, self._instruments = ffi.new("br_belief *"), dict[str, int]()
        self._tuning, nominal = car.tuning, controller.nominal
        if nominal is not None:  # it knows no car yet
            nominal.set_values(MpcSettings().parameters(car, nominal.manifest.problem.name))
        self._by_weights = bool(controller.weights_version)
        self.estimate(self._tuning.estimation(nominal=not self._by_weights))
        self._refusals = ffi.new("int[]", library.BR_REFUSALS)
        self._refused: State | None = None
        self.last_error = ""
        """Of the last step that was broken; empty if none was."""
        self.decision = Decision()
        """Of the newest cycle."""
        self.newest: State | None = None
        """The newest state that counts."""
        self.belief: Belief | None = None
        """What the newest state is estimated to be; None: it is measured, or nothing is known."""
        self.numbering = Numbering()
        """States received and lost, foreign ones left out."""
        self.taken = 0
        """States that count, so far."""
        self.readings_left_out = 0
        """Readings of more instruments than the estimator has room for."""

    @property
    def phase(self) -> Phase:
        """Where in its life the controller is."""
        phase: int = self._counters.phase
        return _PHASES[phase]

    @property
    def delay_s(self) -> float:
        """Delay that is compensated."""
        delay_s: float = self._counters.delay_s
        return delay_s

    @property
    def interval_s(self) -> float:
        """Plant time between two states in a row; 0: not known."""
        interval_s: float = self._counters.interval_s
        return interval_s

    @property
    def time_s(self) -> float:
        """Plant time of the newest state: its own, or another one where that is not believed."""
        time_s: float = self._counters.time_s
        return time_s

    @property
    def levels(self) -> list[int]:
        """Cycles so far by level of the fallback; those on command are not among them."""
        return list(self._counters.levels)

    def count(self, name: str) -> int:
        """One of br_counters in controller/native/bayesrace_cycle.h."""
        return int(getattr(self._counters, name))

    @property
    def faults(self) -> dict[str, int]:
        """States by what speaks against them: :data:`bayesrace.messages.SENSOR_FAULTS`."""
        return dict(zip(SENSOR_FAULTS[1:], list(self._counters.faults)[1:], strict=True))

    @property
    def fault(self) -> str:
        """What speaks against the newest state; empty: nothing."""
        fault: int = self._counters.fault
        return SENSOR_FAULTS[fault]

    @property
    def doubted(self) -> bool:
        """Whether the newest state is not to be driven by."""
        return bool(self._counters.doubted)

    @property
    def fault_text(self) -> str:
        """The same as a sentence."""
        fault, library = self._counters.fault, self._library
        if self.newest is None or not self.newest.estimated:
            return self.controller.artefact.text(library.br_cycle_fault_text(fault))
        if not self.faulty:
            return "position and heading are not known well enough"
        text = self.controller.artefact.text(library.br_estimator_fault_text(fault))
        return f"instrument '{self.faulty}': {text}"

    @property
    def faulty(self) -> str:
        """The instrument that is not believed; empty: each is, or the state is measured."""
        number = self._counters.instrument
        return list(self._instruments)[number] if number >= 0 else ""

    @property
    def info(self) -> Any:
        """Of the compiled controller's newest step: a br_mpc_info."""
        return self._library.br_cycle_info(self._cycle)

    @property
    def output(self) -> StepOutput | None:
        """Of the newest cycle's step; None if it made none. The next cycle overwrites it."""
        return self.controller.result(self._cycle) if self.decision.stepped else None

    @property
    def fallen_back(self) -> bool | None:
        """Whether the newest input was the fallback's for want of a solution; None: the car is
        not driven, or its state is not known."""
        if self.decision.status in (Status.HALTED, Status.NO_STATE):
            return None
        return self.decision.level is not Level.SOLUTION

    def live_by(self, now_s: Callable[[], float]) -> None:
        """Budgets and execution times are measured by this clock [s], not by the system's."""
        self._clock = self.controller.artefact.ffi.callback("double(void *)", lambda _: now_s())
        null = self.controller.artefact.ffi.NULL
        self._library.br_cycle_set_clock(self._cycle, self._clock, null)

    def stop(self) -> None:
        """From the next cycle on slow down along the line to standstill, and stay."""
        self._library.br_cycle_stop(self._cycle)

    def go(self) -> None:
        """From the next cycle on drive."""
        self._library.br_cycle_go(self._cycle)

    def lost(self, silent: bool) -> State | None:
        """The run is over, its plant has gone, or, ``silent``, nothing has come for long.

        Any other may follow, such as the state that is returned: the last one refused, of a
        lockstep run whose plant may still want an answer.
        """
        if not silent:
            self._library.br_cycle_end(self._cycle)
            return None
        return self._refused if self._library.br_cycle_forget(self._cycle) else None

    def estimate(self, settings: Mapping[str, Any]) -> None:
        """How states are estimated: a br_estimation by name. InputError for bad numbers. Nothing
        for a controller without estimator."""
        artefact, nominal = self.controller.artefact, self.controller.nominal
        if not artefact.manifest.estimator:
            return
        error = self._library.br_cycle_set_estimation(
            self._cycle,
            artefact.ffi.NULL if nominal is None else nominal.handle,
            artefact.ffi.new("br_estimation *", dict(settings)),
        )
        artefact.check(error, "estimation")

    def _trust_model(self) -> None:
        """As much as a model with weights, or one without: from one run to the next."""
        if (by_weights := bool(self.controller.weights_version)) != self._by_weights:
            self._by_weights = by_weights
            self.estimate(self._tuning.estimation(nominal=not by_weights))

    def _measurement(self, reading: Reading, known: dict[str, int]) -> Measurement | None:
        """``known``: numbers by name, to which it is added. None: of one instrument too many."""
        number = known.setdefault(reading.instrument, len(known))
        if number >= MOST_INSTRUMENTS:
            del known[reading.instrument]
            self.readings_left_out += 1
            return None
        values = reading.values
        return Measurement(
            reading.time_s,
            number,
            [_INDEX[name] for name in values],
            [value for value, _ in values.values()],
            [deviation for _, deviation in values.values()],
        )

    @property
    def instruments(self) -> dict[str, Any]:
        """What has become of the readings of each instrument so far: a br_instrument."""
        library = self._library
        estimator = library.br_cycle_estimator(self._cycle)
        return {
            name: library.br_estimator_instrument(estimator, number)
            for name, number in self._instruments.items()
        }

    @property
    def vx_mps(self) -> float:
        """Speed in the newest state, measured or estimated; 0 where it is not known."""
        if self.belief is not None:
            return float(self.belief.x[_VX])
        return 0.0 if self.newest is None or self.newest.estimated else self.newest.x[_VX]

    def observe(self, state: State) -> bool:
        """Takes a state that has arrived; False if it is not to be driven on."""
        measured, delays_s = self._measured, state.actuation_delays[2::3]
        newest = self.newest
        begins = newest is None or (state.epoch, state.run) != (newest.epoch, newest.run)
        instruments = {} if begins else self._instruments
        measured.epoch, measured.run, measured.seq = state.epoch, state.run, state.seq
        measured.time_s, measured.lockstep = state.time_s, state.lockstep
        measured.x, measured.u_applied = state.x, state.u_applied
        measured.delays = len(delays_s)
        if delays_s:
            measured.delays_s[0 : len(delays_s)] = delays_s
        measured.estimated, measured.measurements = state.estimated, 0
        if state.estimated:
            found = (self._measurement(one, instruments) for one in state.readings)
            known = [one for one in found if one is not None]
            measured.measurements = fill(measured.measured, known)
        library = self._library
        reception = library.br_cycle_observe(self._cycle, measured)
        if reception != library.BR_STATE_FOREIGN:
            if self.newest is not None and state.epoch != self.newest.epoch:
                self.numbering.restart()
            self.numbering.note(state.seq)
        if reception != library.BR_STATE_NEW:
            self._refused = state
            return False
        self.taken += 1
        self.newest, self.belief, self._instruments = state, None, instruments
        if begins and state.estimated:
            self._trust_model()
        if state.estimated:
            estimator = library.br_cycle_estimator(self._cycle)
            self.belief = read(self.controller.artefact, estimator, self._believed)
        return True

    def decide(
        self,
        decided_at_s: float,
        budget_s: float = 0.0,
        spent_s: float = 0.0,
        environment: Environment | None = None,
    ) -> Decision:
        """The input by the newest state, decided at this plant time.

        ``budget_s``: how long after its release the cycle should be done; 0: no limit but the
        step's own. ``spent_s``: how long ago the release is. InputError before the first state.
        """
        decision, decided, around = self.decision, self._decided, self._null
        if environment is not None:
            around = self._around
            around.speed_limit_mps, around.speed_limit_rate_mps2 = environment
        error = self._library.br_cycle_decide(
            self._cycle, around, decided_at_s, budget_s, spent_s, decided
        )
        self.controller.artefact.check(error, "control cycle")
        self.controller.raise_pending()
        decision.d, decision.delta_rate = decided.u
        decision.level, decision.status = _LEVELS[decided.level], decided.status
        decision.decided_at_s, decision.delay_s = decided.decided_at_s, decided.delay_s
        decision.fault = decided.fault
        decision.step_us, decision.stepped = decided.step_us, bool(decided.stepped)
        decision.late_s = decided.late_s
        decision.refused = self.refusals if budget_s > 0 and decision.stepped else ()
        if decision.status == Status.STEP_FAILED:
            text = self._library.br_mpc_error_text(decided.error)
            self.last_error = self.controller.last_error or self.controller.artefact.text(text)
        return decision

    def sent(self, decided_at_s: float, u: tuple[float, ...]) -> None:
        """What another controller has sent, which drives: this one is its shadow."""
        self._library.br_cycle_sent(self._cycle, decided_at_s, u)

    def braking(self, seq: int) -> BrakingPlan | None:
        """What the car's guard shall do if nothing more comes; None for a car that is halted or
        whose controller knows no line."""
        plan, newest = self._braking, self.newest
        if newest is None or self._library.br_cycle_brake(self._cycle, plan):
            return None
        return BrakingPlan(
            seq=seq,
            source_time_ns=clock.monotonic_ns(),
            epoch=newest.epoch,
            run=newest.run,
            begins_s=max(plan.begins_s, 0.0),
            step_s=plan.step_s,
            d=tuple(round(one, 6) for one in plan.duty[0 : plan.rows]),
            delta=tuple(round(one, 6) for one in plan.delta_rad[0 : plan.rows]),
        )

    def prepare(self, period_s: float, budget_s: float = 0.0) -> None:
        """Preparation phase for a state that is expected a period after the last one."""
        self._library.br_cycle_prepare(self._cycle, period_s, budget_s)

    @property
    def refusals(self) -> tuple[int, ...]:
        """Where the newest step's or preparation's time ran out: all that its clock has changed."""
        refusals = self._refusals
        return tuple(refusals[0 : self._library.br_cycle_get_refusals(self._cycle, refusals)])

    def repeat(self, refused: Sequence[int]) -> None:
        """The next :meth:`decide` or :meth:`prepare` with a budget runs out of time there, in place
        of by the clock."""
        error = self._library.br_cycle_repeat(self._cycle, list(refused), len(refused))
        self.controller.artefact.check(error, "repetition")

    def rehearse(self) -> None:
        """Runs through a cycle without any effect, so that its code and data are in the caches."""
        self._library.br_cycle_rehearse(self._cycle)
