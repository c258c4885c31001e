"""The car as a simulated thing: guarded input, the true dynamics, one sampling period at a time.

The guard is the car's own: whatever arrives, drive command, steering rate and steering angle stay
within the car's limits, what is not finite never gets to the drive, and without a usable command
the car brakes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, Discretisation
from bayesrace.vehicles.models import Model
from bayesrace.vehicles.parameters import CarParameters
from plant.braking import Planned

if TYPE_CHECKING:
    import casadi as ca

__all__ = [
    "PLANT",
    "Command",
    "Compile",
    "GuardCounters",
    "PlantGuard",
    "Simulator",
    "checked_start",
    "hold_in_turn",
    "plant_discretisation",
]

Command = Sequence[float] | Planned | None
"""Drive command and steering rate, what the braking plan makes of them, or None: brake."""

Compile = Callable[["ca.Function"], "ca.Function"]
"""Makes machine code of a function, to the same bits."""


def plant_discretisation(rate_hz: float = 50.0) -> Discretisation:
    """How the plant integrates when it samples its state at this rate.

    Raises InputError unless a period is a whole number of integration steps.
    """
    substeps = round(PLANT_SUBSTEP_HZ / rate_hz) if rate_hz > 0 else 0
    if substeps < 1 or abs(substeps * rate_hz - PLANT_SUBSTEP_HZ) > 1e-6:
        raise InputError(
            f"the plant cannot sample at {rate_hz:g} Hz: its period must be a whole number of "
            "milliseconds; 50, 100, 200, 250 or 500 Hz will do"
        )
    step_s = substeps / PLANT_SUBSTEP_HZ
    return Discretisation(scheme=PLANT_SCHEME, step_s=step_s, substeps=substeps)


PLANT: Final = plant_discretisation()

_CLIP_TOLERANCE: Final = 1e-9
"""Excess that is rounding of the sender's arithmetic: corrected, not counted as clipped."""

_SLOWEST: Final = 1e-6
"""Squared speed by which is divided."""


@dataclass(slots=True)
class GuardCounters:
    """How often the guard had to act since it was made."""

    rejected: int = 0
    """Commands that were not finite; the car braked instead."""
    clipped: int = 0
    """Commands beyond a limit of drive command, steering rate or steering angle."""
    planned: int = 0
    """Periods, or parts of one, driven by the controller's braking plan."""
    braked: int = 0
    """Periods, or parts of one, with neither a usable command nor a braking plan."""


class PlantGuard:
    """Turns any command into one that the car's actuators can follow for one period."""

    def __init__(self, car: CarParameters) -> None:
        self._d_min, self._d_max, self._drive = car.d_min, car.d_max, car.drive
        self._rate_max = car.delta_rate_max_radps
        self._delta_max = car.delta_max_rad
        self._brake_fade_mps, self._brake_d, self._brake_slow = car.brake_numbers.values()
        self.counters = GuardCounters()

    def apply(self, u: Command, x: Floats, duration_s: float) -> tuple[float, float]:
        """Drive command and steering rate [rad/s] that act so long for the command ``u`` in state
        ``x`` (7,); None brakes."""
        vx_mps, delta_rad = float(x[3]), float(x[6])
        lowest = self._drive.braking(vx_mps, self._d_min, duration_s)
        if u is None:
            return self._brake(vx_mps, lowest)
        if isinstance(u, Planned):
            self.counters.planned += 1
            d, rate = u.command(delta_rad, duration_s)
            if d < 0:  # the car may stand sooner than the model that planned
                d = max(d, self._braking(vx_mps, lowest))
        else:
            d, rate = float(u[0]), float(u[1])
        if not (math.isfinite(d) and math.isfinite(rate)):
            self.counters.rejected += 1
            return self._brake(vx_mps, lowest)
        highest = self._d_max * self._drive.available(vx_mps, float(x[4]))
        d_safe = min(max(d, lowest), highest)
        rate_safe = self._steerable(rate, delta_rad, duration_s)
        if abs(d_safe - d) > _CLIP_TOLERANCE or abs(rate_safe - rate) > _CLIP_TOLERANCE:
            self.counters.clipped += 1
        return d_safe, rate_safe

    def _brake(self, vx_mps: float, lowest: float) -> tuple[float, float]:
        """Braking with the steering held."""
        self.counters.braked += 1
        return self._braking(vx_mps, lowest), 0.0

    def _braking(self, vx_mps: float, lowest: float) -> float:
        """The drive command that the car can hold while it rolls, fading to none at standstill."""
        held = self._brake_d + self._brake_slow / max(vx_mps * vx_mps, _SLOWEST)
        share = min(max(vx_mps / self._brake_fade_mps, 0.0), 1.0)
        return max(max(self._d_min, -held) * share, lowest)

    def _steerable(self, rate: float, delta_rad: float, duration_s: float) -> float:
        """The nearest rate within its limit that leaves the angle within its own at the end."""
        lowest = (-self._delta_max - delta_rad) / duration_s
        highest = (self._delta_max - delta_rad) / duration_s
        rate = min(max(rate, lowest), highest)
        return min(max(rate, -self._rate_max), self._rate_max)

    def angle_after(self, delta_rad: float, rate: float, duration_s: float) -> float:
        """Steering angle after that long at ``rate``, free of the integrator's rounding."""
        return min(max(delta_rad + duration_s * rate, -self._delta_max), self._delta_max)


def checked_start(x0: Sequence[float], car: CarParameters) -> Floats:
    """The start state (7,) of a run; InputError if ``car`` cannot be in it."""
    start = np.asarray(x0, dtype=np.float64)
    if start.shape != (7,) or not np.isfinite(start).all():
        raise InputError(f"start state needs 7 finite numbers, got {x0!r}")
    if abs(start[6]) > car.delta_max_rad:
        raise InputError(
            f"start state has a steering angle of {start[6]:.3f} rad; "
            f"{car.name} steers within ±{car.delta_max_rad} rad"
        )
    return start


def hold_in_turn(
    x: Floats,
    commands: Sequence[tuple[int, Command]],
    substeps: int,
    hold: Callable[[Command, int], tuple[float, float]],
) -> tuple[float, float]:
    """One period of (substeps, command) in order of time; the mean of what acted.

    ``hold`` applies one command for a number of substeps to the state ``x`` and says what acted. If
    it fails within the period, ``x`` is that before the period again.
    """
    if sum(count for count, _ in commands) != substeps:
        raise ValueError(f"the commands must last {substeps} substeps together")
    before, d_sum, rate_sum = x.copy(), 0.0, 0.0
    try:
        for count, u in commands:
            if count == 0:
                continue
            d, rate = hold(u, count)
            d_sum += count * d
            rate_sum += count * rate
    except Exception:
        x[:] = before
        raise
    return d_sum / substeps, rate_sum / substeps


class _Substeps:
    """A CasADi map x_next = F(x, u, p), applied to x and u in place.

    An ordinary call converts to and from DM, which costs more than the integration itself.
    """

    def __init__(self, function: Any, x: Floats, u: Floats, p: Floats) -> None:
        self._x, self._x_next = x, np.zeros_like(x)
        buffers = []
        for before, after in ((x, self._x_next), (self._x_next, x)):
            buffer, evaluate = function.buffer()
            for i, argument in enumerate((before, u, p)):
                buffer.set_arg(i, argument.data)
            buffer.set_res(0, after.data)
            buffers.append((buffer, evaluate))
        self._evaluate = tuple(evaluate for _, evaluate in buffers)
        self._alive = function, p, buffers  # the buffers do not keep what they refer to

    def advance(self, count: int) -> None:
        """So many substeps."""
        forth, back = self._evaluate
        for _ in range(count // 2):
            forth()
            back()
        if count % 2:
            forth()
            self._x[:] = self._x_next


class Simulator:
    """A car that advances by one sampling period per call; deterministic to the bit.

    ``x`` is the state after the last step: read it, but do not write into it.
    """

    def __init__(
        self,
        model: Model,
        discretisation: Discretisation = PLANT,
        compiled: Compile | None = None,
    ) -> None:
        """Without ``compiled``, CasADi interprets the equations, which takes five times as long."""
        self.car = model.car
        self.step_s = discretisation.step_s
        self.substeps = discretisation.substeps
        self.guard = PlantGuard(model.car)
        self.u_applied: tuple[float, float] = (0.0, 0.0)
        """What acted during the last period; the mean over it if it changed within."""
        self.steps = 0
        self.x: Floats = np.zeros(len(model.states))
        self._u: Floats = np.zeros(len(model.inputs))
        substep = Discretisation(
            scheme=discretisation.scheme, step_s=self.step_s / self.substeps, substeps=1
        )
        parameters = np.array(model.parameters, dtype=np.float64)
        function = substep.for_any_car(model)
        function = compiled(function) if compiled else function
        self._equations = _Substeps(function, self.x, self._u, parameters)

    @property
    def time_s(self) -> float:
        """Time since the reset, exact multiples of the period."""
        return self.steps * self.step_s

    def reset(self, x0: Sequence[float]) -> None:
        """Put the car into state ``x0`` at time zero; InputError if it cannot be in it."""
        self.x[:] = checked_start(x0, self.car)
        self.u_applied = (0.0, 0.0)
        self.steps = 0

    def step(self, u: Command) -> None:
        """Hold the command ``u`` = (d, delta_rate) for one period; None brakes."""
        self.u_applied = self._hold(u, self.substeps)
        self.steps += 1

    def step_switched(self, commands: Sequence[tuple[int, Command]]) -> None:
        """One period in which the command changes: (substeps, command) in order of time.

        The substeps must add up to :attr:`substeps`.
        """
        if len(commands) == 1 and commands[0][0] == self.substeps:
            self.step(commands[0][1])
            return
        self.u_applied = hold_in_turn(self.x, commands, self.substeps, self._hold)
        self.steps += 1

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """For so many substeps; what acted."""
        x, duration_s = self.x, self.step_s * count / self.substeps
        delta = float(x[6])
        applied = self.guard.apply(u, x, duration_s)
        self._u[0], self._u[1] = applied
        self._equations.advance(count)
        x[6] = self.guard.angle_after(delta, applied[1], duration_s)
        return applied
