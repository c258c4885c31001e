"""How a cycle went, as a message."""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.messages import NOT_REPORTED, SENSOR_FAULTS, State, Telemetry
from controller.driver import Decision
from controller.interface import NO_PLAN, StepOutput

__all__ = ["Timing", "telemetry_of"]

_SCALE, _LARGEST = 1e6, 1e6
_LARGEST_MEASURE = 1e12
_NO_OUTPUT = StepOutput(u=np.zeros(2), plan_u=NO_PLAN)


@dataclass(slots=True)
class Timing:
    """Times of the cycle at hand, as in :class:`bayesrace.messages.Telemetry`, and the loop's
    counters since the start."""

    released_ns: int = 0
    received_ns: int = 0
    missed: bool = False
    wake_us: float = 0.0
    decode_us: float = 0.0
    prepare_us: float = 0.0
    solve_us: float = 0.0
    encode_us: float = 0.0
    ticks: int = 0
    """Cycles, late ones included."""
    skipped: int = 0
    """Releases passed over because a cycle before took too long."""
    misses: int = 0
    """Cycles whose actuation was on its way only after the deadline."""
    overruns: int = 0
    """Cycles that took more than their budget."""
    late_states: int = 0
    """Late cycles: further ones after a release, for a state that came after its window."""

    @property
    def tick(self) -> int:
        """Number of the newest cycle's release."""
        return self.ticks + self.skipped - self.late_states - 1


def telemetry_of(
    seq: int, state: State, decision: Decision, output: StepOutput | None, timing: Timing
) -> Telemetry:
    """The message of one cycle; ``output``: of its step, if one was made."""
    output = output or _NO_OUTPUT
    numbers = {"cost": output.cost, "cost_shifted": output.cost_shifted, **output.numbers}
    return Telemetry(
        seq=seq,
        source_time_ns=time.monotonic_ns(),
        run=state.run,
        state_seq=state.seq,
        status=decision.status,
        fallback=int(decision.level),
        tick=timing.tick,
        released_ns=timing.released_ns,
        received_ns=timing.received_ns,
        missed=timing.missed,
        wake_us=timing.wake_us,
        decode_us=timing.decode_us,
        prepare_us=timing.prepare_us,
        solve_us=decision.step_us or timing.solve_us,
        encode_us=timing.encode_us,
        delay_s=decision.delay_s,
        plan_x=_finite(output.plan_x),
        plan_u=_finite(output.plan_u),
        tube_m=_finite(output.tube_m),
        sensor_fault=SENSOR_FAULTS[decision.fault],
        second_start=output.second_start,
        **{name: _known(numbers.get(name, none), none) for name, none in NOT_REPORTED.items()},
    )


def _finite(plan: Floats) -> tuple[float, ...]:
    """The plan row by row, for viewing: to six digits, which halves the size of a log.

    Nothing of it if any of it is no number (receivers would refuse it).
    """
    if not plan.size:
        return ()
    scaled = np.rint(plan.ravel() * _SCALE)
    if not np.maximum.reduce(np.abs(scaled)) <= _LARGEST * _SCALE:
        return ()
    return tuple((scaled / _SCALE).tolist())


def _known(number: float, none: float) -> Any:
    """A number that telemetry can have, or what it has in place of one that is not known."""
    known = 0.0 <= number <= _LARGEST_MEASURE if none < 0 else math.isfinite(number)
    return number if known else none
