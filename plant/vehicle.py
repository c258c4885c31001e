"""The car as a run drives it: the built-in equations, an FMU or slipx, behind one interface; and
the guard, what the car does by itself with a command, or without one.

Whatever arrives, drive command, steering rate and steering angle stay within the car's limits, and
what is not finite never gets to the drive. Without a usable command the car follows the braking
plan that the controller sends ahead after each cycle (:class:`bayesrace.messages.BrakingPlan`), row
by row, in plant time; without a plan it brakes with the steering held.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.messages import BrakingPlan, Reading
from bayesrace.plant.settings import SimulatorName
from bayesrace.plant.world import UNCHANGED, World
from bayesrace.vehicles.parameters import Car

if TYPE_CHECKING:
    import casadi as ca

__all__ = [
    "Command", "Compile", "FmuFault", "GuardCounters", "Planned", "PlantGuard", "Vehicle",
    "open_vehicle", "planned_at",
]  # fmt: skip

Compile = Callable[["ca.Function"], "ca.Function"]
"""Makes machine code of a function, to the same bits."""

_STATES: Final = 7

_EARLY: Final = 2.0
"""Rows by which a plan may lie in the future when it takes over."""

_CLIP_TOLERANCE: Final = 1e-9
"""Excess that is rounding of the sender's arithmetic: corrected, not counted as clipped."""

_SLOWEST: Final = 1e-6
"""Squared speed by which is divided."""


class FmuFault(RuntimeError):  # noqa: N818 - the car failed, not this program
    """The simulated car crashed, hung, refused a step, gave an unusable value or ended the run.

    The message names it, what happened, when (plant time), and its last message. The input
    was not bad: the run ends, the plant process goes on.
    """


class Planned:
    """A command that depends on the steering angle at which it begins to act.

    A plan has steering angles, not rates: they do not depend on when it takes over.
    """

    def __init__(self, plan: BrakingPlan, now_s: float) -> None:
        self._plan, self._now_s = plan, now_s

    def command(self, delta_rad: float, duration_s: float) -> tuple[float, float]:
        """Drive command and steering rate [rad/s] that follow the plan for so long."""
        plan = self._plan
        row = min(max(int((self._now_s - plan.begins_s) / plan.step_s), 0), len(plan.d) - 1)
        ends_s = plan.begins_s + plan.step_s * np.arange(1, len(plan.d) + 1)
        target = float(np.interp(self._now_s + duration_s, ends_s, plan.delta))
        return plan.d[row], (target - delta_rad) / duration_s


def planned_at(plan: BrakingPlan | None, now_s: float) -> Planned | None:
    """What the plan says at this plant time; None: nothing, it is over or there is none."""
    if plan is None or not plan.d or len(plan.d) != len(plan.delta):
        return None
    row = (now_s - plan.begins_s) / plan.step_s
    return Planned(plan, now_s) if -_EARLY <= row < len(plan.d) else None


Command = Sequence[float] | Planned | None
"""Drive command and steering rate, what the braking plan makes of them, or None: brake."""


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

    def __init__(self, car: Car) -> None:
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


class Vehicle(ABC):
    """A car that advances by one sampling period per call, its actuators guarded.

    :meth:`reset`, :meth:`step` and :meth:`step_switched` raise :class:`FmuFault` when the car
    itself fails; ``x``, ``u_applied`` and ``steps`` are then those of the last good sample, and the
    next :meth:`reset` begins with a car as new.
    """

    real: ClassVar[bool] = False
    """Whether it is a real car, whose true state is not known: it does not wait for its periods,
    a command acts at once (:meth:`actuate`), and its runs end when it stands."""
    command_s: float = 0.0
    """From sending a command to its acting."""

    def __init__(self, car: Car, step_s: float, substeps: int) -> None:
        self.car = car
        """Whose limits the guard keeps."""
        self.step_s = step_s
        """Sampling period."""
        self.substeps = substeps
        """Parts of a period at whose beginnings a command can change."""
        self.guard = PlantGuard(car)
        self.u_applied: tuple[float, float] = (0.0, 0.0)
        """What acted during the last period; the mean over it if it changed within."""
        self.steps = 0
        """Periods since the reset."""
        self.x: Floats = np.zeros(_STATES)
        """State (7,) after the last step: read it, but do not write into it."""

    @property
    def time_s(self) -> float:
        """Time since the reset, exact multiples of the period."""
        return self.steps * self.step_s

    def reset(self, x0: Sequence[float]) -> None:
        """Put the car into state ``x0`` at time zero; InputError if it cannot be in it."""
        start = np.asarray(x0, dtype=np.float64)
        if start.shape != (_STATES,) or not np.isfinite(start).all():
            raise InputError(f"start state needs {_STATES} finite numbers, got {x0!r}")
        if abs(start[6]) > self.car.delta_max_rad:
            raise InputError(
                f"start state has a steering angle of {start[6]:.3f} rad; "
                f"{self.car.name} steers within ±{self.car.delta_max_rad} rad"
            )
        self._place(start)
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
        if sum(count for count, _ in commands) != self.substeps:
            raise ValueError(f"the commands must last {self.substeps} substeps together")
        if len(commands) == 1:
            self.step(commands[0][1])
            return
        before, d_sum, rate_sum = self.x.copy(), 0.0, 0.0
        try:
            for count, u in commands:
                if count == 0:
                    continue
                d, rate = self._hold(u, count)
                d_sum += count * d
                rate_sum += count * rate
        except Exception:
            self.x[:] = before
            raise
        self.u_applied = d_sum / self.substeps, rate_sum / self.substeps
        self.steps += 1

    @property
    def silent(self) -> str:
        """Why a real car has to stop; else empty."""
        return ""

    def readings(self) -> tuple[Reading, ...] | None:
        """What instruments of its own have measured since they were asked last; None: it has
        none, and its state is known."""
        return None

    def report(self) -> str:
        """What the plant's status says of it, if anything."""
        return ""

    def begins(self, zero_ns: int) -> None:  # noqa: B027 - a simulated car needs no clock
        """Plant time 0 is at this moment of the monotonic clock."""

    def actuate(self, u: Command) -> None:
        """A command that acts from now on; for real cars."""
        raise NotImplementedError("a simulated car waits for its periods")

    @abstractmethod
    def _place(self, start: Floats) -> None:
        """Begin at time zero in this state (7,)."""

    @abstractmethod
    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """Hold a command for so many substeps; what acted. On a fault ``x`` stays."""


@contextmanager
def open_vehicle(
    car: Car,
    fmu: Path | None = None,
    fmu_map: Path | None = None,
    rate_hz: float = 50.0,
    compiled: Compile | None = None,
    *,
    simulator: SimulatorName = "equations",
    world: World = UNCHANGED,
) -> Iterator[Vehicle]:
    """The car by the built-in equations, by slipx, or by an FMU and the map of its variables.

    ``compiled``, ``world``: of the equations, see :class:`bayesrace.plant.simulator.Simulator`.

    Raises InputError if the FMU, the map, the rate or the car cannot be used.
    """
    if world.root and (fmu is not None or simulator != "equations"):
        raise InputError("world: only the built-in car can change while it drives")
    if fmu is None:
        if fmu_map is not None:
            raise InputError(f"map {fmu_map} without an FMU to apply it to: add --fmu")
        if simulator == "slipx":
            from bayesrace.plant.slipx_car import SlipxSimulator

            yield SlipxSimulator(car, rate_hz)
            return
        from bayesrace.plant.simulator import Simulator, plant_discretisation
        from bayesrace.vehicles.models import dynamic

        yield Simulator(dynamic(car), plant_discretisation(rate_hz), compiled, world)
        return
    if simulator != "equations":
        raise InputError(f"--simulator {simulator} and --fmu {fmu}: only one can be the car")
    from bayesrace.plant.fmu.simulator import open_fmu  # the built-in car does not wait for fmpy

    with open_fmu(car, fmu, fmu_map, rate_hz) as vehicle:
        yield vehicle
