"""The car as an object with ``reset`` and ``step``; and how one's own takes its place."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.api.values import Input, Range, State, car_of, finite_input, number, track_of
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.settings import SimulatorName
from bayesrace.plant.vehicle import Command, Vehicle, open_vehicle
from bayesrace.plant.world import UNCHANGED, World, get_world
from bayesrace.sensors import EXACT, Sensors, get_sensors
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

__all__ = ["OwnSimulator", "OwnVehicle", "Simulator"]

_START_MPS: Final = 0.1


class OwnSimulator(Protocol):
    """What :func:`bayesrace.drive` can drive besides :class:`Simulator`.

    An attribute ``step_s`` states the time between two states [s]; without, it is taken to be 0.02.
    """

    def reset(self, x0: Floats) -> "State | ArrayLike":
        """Puts the car into a state (7,); returns the state it is in."""

    def step(self, u: Floats) -> "State | ArrayLike":
        """Holds an input (2,) for one period; returns the state (7,) that is reached."""


class Simulator:
    """A car on a track: the built-in equations, an FMU, or slipx, with its actuators' limits.

    A command beyond the car's limits is clipped as the car's actuators would, and counted; what
    acted is :attr:`u_applied`. States are true ones; ``sensors`` are of :func:`bayesrace.drive`.
    """

    def __init__(
        self,
        car: Car | Path | str,
        track: Track | Path | str,
        *,
        step_s: float = 0.02,
        engine: SimulatorName = "equations",
        fmu: Path | str | None = None,
        world: World | Path | str | None = None,
        sensors: Sensors | Path | str | None = None,
        seed: int = 0,
        delay_s: float = 0.0,
    ) -> None:
        """Without options: the built-in equations, sampled each 20 ms.

        - ``step_s``: sampling period, 0.001 to 0.1 s.
        - ``engine``: what plays the car, ``"equations"`` or ``"slipx"`` (docs/f1tenth.md).
        - ``fmu``: an FMU plays it; the simulator must then be closed (:meth:`close`, or ``with``).
        - ``world``: what changes while the car drives (docs/world.md).
        - ``sensors``: what the controller is told in :func:`bayesrace.drive`: a built-in set such
          as ``"odometry"``, or a TOML file (docs/sensors.md); ``seed``: of their errors.
        - ``delay_s``: what states, and inputs, take each in :func:`bayesrace.drive`, so that an
          input acts twice as long after its state.

        InputError for a car without tyres or inertia, which the equations need, and whatever else
        cannot be used.
        """
        from bayesrace.codegen.compiler import compiled

        self.car = car = car_of(car)
        """Whose equations and limits they are."""
        self.track = track = track_of(track, car)
        """Where it starts."""
        self.seed, self.delay_s = seed, number(delay_s, "delay_s", 0, 1, "seconds, 0 to 1")
        number(step_s, "step_s", 0.001, 0.1, "seconds, 0.001 to 0.1")
        if engine not in get_args(SimulatorName):
            known = ", ".join(get_args(SimulatorName))
            raise InputError(f"engine = {engine!r:.60}: give one of {known}")
        if sensors is None:
            self.sensors = EXACT
        else:
            self.sensors = sensors if isinstance(sensors, Sensors) else get_sensors(sensors)
        if world is not None and not isinstance(world, World):
            world = get_world(world)
        if fmu is not None and engine != "equations":
            raise InputError(f"fmu = {fmu}, engine = {engine!r}: only one can play the car")
        self._opened, self._closed = ExitStack(), False
        self.vehicle: Vehicle = self._opened.enter_context(
            open_vehicle(
                car, None if fmu is None else Path(fmu), None, 1 / step_s, compiled,
                simulator=engine, world=world or UNCHANGED,
            )
        )  # fmt: skip
        """What plays the car, as the plant process has it."""
        self._range = Range(car, track)
        self.reset()

    @property
    def step_s(self) -> float:
        """Sampling period [s]."""
        return self.vehicle.step_s

    @property
    def time_s(self) -> float:
        """Since the reset."""
        return self.vehicle.time_s

    @property
    def state(self) -> State:
        """Where the car is."""
        return State(*self.vehicle.x.tolist())

    @property
    def u_applied(self) -> Input:
        """What acted during the last period."""
        return Input(*self.vehicle.u_applied)

    def reset(self, x0: "State | ArrayLike | None" = None) -> State:
        """The state that it is put into at time zero: ``x0`` (7,), or the start line at walking
        pace. InputError for a state that this car cannot be in."""
        if x0 is None:
            x0 = State(*self.track.start_pose(), _START_MPS, 0.0, 0.0, 0.0)
        self._check_open()
        self.vehicle.reset(self._range.checked(x0))
        return self.state

    def step(self, u: "Input | ArrayLike") -> State:
        """The state after one period with this input held; FmuFault if the car fails."""
        given = finite_input(u, "u")
        self._check_open()
        self.vehicle.step(given)
        return self.state

    def _check_open(self) -> None:
        if self._closed:
            raise InputError("the simulator has been closed: make another one")

    def __repr__(self) -> str:
        return f"<Simulator of '{self.car.name}' on '{self.track.name}' at {self.time_s:g} s>"

    def close(self) -> None:
        """Ends what was opened: an FMU's process. It cannot be used any more."""
        self._opened.close()
        self._closed = True

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class OwnVehicle(Vehicle):
    """A simulator of one's own as what a run drives; its limits are its own matter."""

    def __init__(self, own: OwnSimulator, car: Car, track: Track) -> None:
        """InputError for an object without ``reset`` and ``step``."""
        missing = [name for name in ("reset", "step") if not callable(getattr(own, name, None))]
        if missing:
            raise InputError(
                f"simulator = {type(own).__name__}: it has no {' and no '.join(missing)}; give a "
                "bayesrace.Simulator, or an object with reset(x0) -> state and step(u) -> state"
            )
        step_s = number(getattr(own, "step_s", 0.02), "simulator.step_s", 1e-4, 10, "seconds")
        super().__init__(car, step_s, 1)
        self._own, self._range = own, Range(car, track)

    def _place(self, start: Floats) -> None:
        self.x[:] = self._range.checked(self._own.reset(start.copy()))

    def _hold(self, u: Command, _count: int) -> tuple[float, float]:
        assert isinstance(u, Sequence)  # noqa: S101 - in lockstep each period has its answer
        d, delta_rate = u
        self.x[:] = self._range.checked(self._own.step(np.array([d, delta_rate])))
        return d, delta_rate
