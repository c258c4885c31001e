"""The closed loop of controller and car, and what it leaves: laps, arrays, a table, a picture."""

from contextlib import ExitStack, closing
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesrace.api.controller import Controller
from bayesrace.api.simulator import OwnSimulator, OwnVehicle, Simulator
from bayesrace.api.values import State, number, optional
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.log import LogWriter
from bayesrace.messages import QUANTITIES, SENSOR_FAULTS
from bayesrace.operation.analysis.laps import LapTimes
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.raceline import RaceLine, same_track
from bayesrace.scene import Scene
from bayesrace.sensors import EXACT
from bayesrace.tracks import Track
from bayesrace.vehicles import Car, car_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Run", "drive", "ended"]


def drive(
    controller: Controller,
    simulator: "Simulator | OwnSimulator",
    laps: int = 2,
    *,
    x0: "State | ArrayLike | None" = None,
    max_time_s: float | None = None,
    log: Path | str | None = None,
) -> "Run":
    """Drives until the laps are done, or the time is up.

    Everything happens in simulated time in this process: the run is equal, to the bit, to one of a
    controller and a plant process in lockstep.

    - ``laps``: crossings of the start line; 0: no limit but ``max_time_s``.
    - ``x0``: start state; None: the start line at walking pace.
    - ``max_time_s``: None: three times the racing line's time for so many laps, and 2 s.
    - ``log``: file for a recording (MCAP), which :class:`bayesrace.Log` opens.

    InputError for what cannot be driven; what a simulator of your own raises passes through.
    """
    if not isinstance(laps, int | np.integer) or laps < 0 or (laps == 0 and max_time_s is None):
        raise InputError(f"laps = {laps!r:.60}: give a whole number from 1 on, or 0 and max_time_s")
    if max_time_s is not None:
        number(max_time_s, "max_time_s", 0.0, 1e6, "seconds")
    car, track = controller.car, controller.track
    disturbed: dict[str, Any] = {"sensors": EXACT, "seed": 0, "delay_s": 0.0}
    if isinstance(simulator, Simulator):
        _check_alike(controller, simulator)
        vehicle = simulator.vehicle
        disturbed = {name: getattr(simulator, name) for name in disturbed}
    else:
        vehicle = OwnVehicle(simulator, car, track)
    start = None if x0 is None else list(controller._range.checked(x0))
    about = {"drive": {"car": car_text(car), "track": track.name}}
    with ExitStack() as opened:
        opened.callback(controller.reset)
        writer = None
        if log is not None:
            scene = Scene(car, track, controller.line)
            writer = opened.enter_context(closing(LogWriter(Path(log), about, scene)))
        loop = ClosedLoop(
            car, track, controller.line, controller._predictive, vehicle, writer,
            controller._cycle_settings, **disturbed,
        )  # fmt: skip
        driven = loop.drive(int(laps), max_time_s, x0=start)
    return Run(driven, controller.line, laps)


def _check_alike(controller: Controller, simulator: Simulator) -> None:
    """InputError for a car of another name, or another track; a car of the same name may have other
    numbers than those that the controller knows."""
    if simulator.car.name != controller.car.name:
        raise InputError(
            f"the simulator plays the car '{simulator.car.name}', the controller drives "
            f"'{controller.car.name}': make both of one car, or of car.changed(...)"
        )
    if not same_track(simulator.track.identity, controller.track.identity):
        raise InputError(
            f"the simulator is on the track '{simulator.track.name}', the controller on "
            f"'{controller.track.name}': make both on one"
        )


class Run:
    """What was driven: true states, inputs and decisions, one row a sampling period."""

    def __init__(self, driven: Driven, line: RaceLine, asked: int) -> None:
        self.driven = driven
        """The same run, as the command line judges it and learns from it."""
        self.line = line
        """What was followed."""
        self.asked = asked
        """Laps that were to be driven; 0: no number."""

    @property
    def t(self) -> Floats:
        """Time of each state [s], shape (n,)."""
        return self.driven.time_s

    @property
    def x(self) -> Floats:
        """True states in the order of :class:`.State`, shape (n, 7)."""
        return self.driven.x

    @property
    def u(self) -> Floats:
        """Inputs that acted from each state to the next, shape (n - 1, 2)."""
        return self.driven.u

    @property
    def laps(self) -> tuple[float, ...]:
        """Lap times [s], the first from the start state; interpolated at the line."""
        return self.driven.laps_s

    @cached_property
    def off_track_m(self) -> Floats:
        """How far the car's centre is outside the track [m], negative inside; at the states up to
        the end of the last lap that was asked for, or at all of a run that did not drive them."""
        if 0 < self.asked <= len(self.laps):
            return self.driven.off_track_m
        return self.driven.projected.off_track_m

    @property
    def off_track(self) -> int:
        """How many of the states that :attr:`off_track_m` has are off the track."""
        return int((self.off_track_m > 0).sum())

    @property
    def status(self) -> NDArray[np.int64]:
        """:class:`bayesrace.Status` of the steps, one for each state that was answered: shape
        (n - 1,), or (n,) where the simulator has failed."""
        return self.driven.statuses

    @property
    def level(self) -> NDArray[np.int64]:
        """Who gave the inputs: :class:`bayesrace.Level`, shape as of :attr:`status`."""
        return self.driven.levels

    @property
    def car(self) -> Car:
        """The car that the controller drove."""
        return self.driven.car

    @property
    def track(self) -> Track:
        """Where it was driven."""
        return self.driven.track

    @property
    def fault(self) -> list[str]:
        """Fault found in each state that was answered; empty: none. See :attr:`.Step.fault`."""
        return [SENSOR_FAULTS[one] for one in self.driven.faults]

    @property
    def end(self) -> str:
        """Why the run ended, a sentence."""
        return ended(self.driven.end.text, self.driven.laps)

    @property
    def weights_version(self) -> str:
        """Of the weights that drove; empty without any."""
        return self.driven.weights_version

    @cached_property
    def _columns(self) -> dict[str, Any]:
        """By name, a row for each state; what is not known of the last one is NaN or -1."""
        count, u = len(self.t), np.full((len(self.t), 2), np.nan)
        u[: len(self.u)] = self.u
        columns: dict[str, Any] = {"t": self.t}
        columns |= dict(zip(QUANTITIES, self.x.T, strict=True))
        columns |= {"d": u[:, 0], "delta_rate": u[:, 1], "lap": self.driven.lap}
        for name in ("status", "level"):
            column = np.full(count, -1, dtype=np.int64)
            known = getattr(self, name)[:count]
            column[: len(known)] = known
            columns[name] = column
        projected = self.driven.projected
        return columns | {"s_m": projected.s_m, "off_track_m": projected.off_track_m}

    def frame(self) -> Any:
        """A pandas DataFrame with a row for each state: t, the state, the input that acted from
        then on, lap, status, level, place along the track, and how far off it is.

        InputError if pandas is not installed.
        """
        return optional("pandas", "campaign").DataFrame(self._columns)

    def plot(self) -> "Figure":
        """A matplotlib figure: the last lap on the track by speed, and speed and inputs over the
        way. InputError if matplotlib is not installed."""
        optional("matplotlib", "race")
        from bayesrace.api.picture import run_figure

        return run_figure(self)

    def _repr_png_(self) -> bytes:
        from bayesrace.operation.report.style import png

        return png(self.plot())

    def __repr__(self) -> str:
        return f"<Run of '{self.driven.car.name}' on '{self.driven.track.name}': {self.driven}>"


def ended(text: str, laps: LapTimes) -> str:
    """Why a run ended, and why fewer laps count than the car has crossed the line."""
    if laps.cut_at is None:
        return text
    return f"{text}; it left out a piece of the track, and no lap counts from there on"
