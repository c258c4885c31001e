"""A vehicle model as another author would write it, for `pythonfmu` to make an FMU of.

Its names, units and signs are not ours, and `tests/foreign_fmu.py` has the map for it. The physics
are the dynamic bicycle's, so that a lap of it can be compared with one of the built-in plant.
"""

import math
from functools import partial
from typing import Any

import numpy as np
from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

from bayesrace.integrators import Discretisation
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic

SUBSTEP_S = 1e-3

INPUTS = {
    "PedalPercent": "drive command in percent, negative brakes",
    "SteerAngleCmd": "wheel angle at the end of the step in deg, positive to the right",
}
PARAMETERS = {
    "startEast": "start position in cm",
    "startNorth": "start position in cm",
    "startCompass": "start heading in deg, clockwise from north",
    "startSpeed": "start speed in km/h",
}
OUTPUTS = {
    "posEast": "position in cm",
    "posNorth": "position in cm",
    "compass": "heading in deg, clockwise from north, 0 to 360",
    "velEast": "velocity in km/h",
    "velNorth": "velocity in km/h",
    "turnRate": "yaw rate in deg/s, clockwise",
}


class ForeignCar(Fmi2Slave):  # type: ignore[misc]
    """ORCA car 1:43; east, north and a compass in place of x, y and a mathematical heading."""

    author = "another author"
    description = "Rear-driven 1:43 car"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.default_experiment = DefaultExperiment(step_size=SUBSTEP_S)
        for name in (*INPUTS, *PARAMETERS):
            setattr(self, name, 0.0)
        step = Discretisation(scheme="rk4", step_s=SUBSTEP_S, substeps=1)
        self._state, self._input = np.zeros(7), np.zeros(2)
        self._advance = step.discretise(dynamic(get_car("orca")))
        for name, text in INPUTS.items():
            self._register(name, text, Fmi2Causality.input)
        for name, text in PARAMETERS.items():
            self._register(name, text, Fmi2Causality.parameter, variability=Fmi2Variability.fixed)
        for name, text in OUTPUTS.items():
            read = partial(self._output, name)
            self._register(name, text, Fmi2Causality.output, getter=read)

    def _register(self, name: str, text: str, causality: Any, **options: Any) -> None:
        self.register_variable(Real(name, causality=causality, description=text, **options))

    def exit_initialization_mode(self) -> None:
        """Puts the car where the parameters say, its wheels at the commanded angle."""
        east, north = self.startEast, self.startNorth
        self._state[:] = 0.0
        self._state[:2] = east / 100.0, north / 100.0
        self._state[2] = math.radians(90.0 - self.startCompass)
        self._state[3] = self.startSpeed / 3.6
        self._state[6] = -math.radians(self.SteerAngleCmd)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Turns the wheels evenly to the commanded angle within the step."""
        angle = -math.radians(self.SteerAngleCmd)
        self._input[:] = self.PedalPercent / 100.0, (angle - self._state[6]) / step_size
        for _ in range(round(step_size / SUBSTEP_S)):
            self._state = np.asarray(self._advance(self._state, self._input)).ravel()
        self._state[6] = angle
        return True

    def _output(self, name: str) -> float:
        x, y, psi, vx, vy, omega = (float(value) for value in self._state[:6])
        cosine, sine = math.cos(psi), math.sin(psi)
        values = {
            "posEast": 100.0 * x,
            "posNorth": 100.0 * y,
            "compass": (90.0 - math.degrees(psi)) % 360.0,
            "velEast": 3.6 * (cosine * vx - sine * vy),
            "velNorth": 3.6 * (sine * vx + cosine * vy),
            "turnRate": -math.degrees(omega),
        }
        return values[name]
