"""Stands for an environment of f110_gym 0.2, which Python 3.11 cannot install: its interface, speed
and steering controllers and steering delay as they are known, around the paper's car."""

import math
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.integrators import Discretisation
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import discrete

__all__ = ["FakeGym"]

STEP_S = 0.01
A_MAX, V_MAX, V_MIN = 9.51, 20.0, -5.0


class FakeGym:
    """One car. ``x`` (7,) is its true state, as BayesRace has it."""

    def __init__(self, car: Car) -> None:
        self._next = discrete(dynamic(car), Discretisation(scheme="rk4", step_s=STEP_S, substeps=4))
        self._car = car
        self.x: Floats = np.zeros(7)
        self.collides = False
        self._buffer: list[float] = []

    def reset(self, poses: Floats) -> tuple[dict[str, Any], float, bool, dict[str, Any]]:
        self.x = np.array([*poses[0], 0.0, 0.0, 0.0, 0.0])
        self._buffer = []
        return self.step(np.zeros((1, 2)))

    def step(self, actions: Floats) -> tuple[dict[str, Any], float, bool, dict[str, Any]]:
        steer, speed = map(float, actions[0])
        acting = self._buffer.pop() if len(self._buffer) == 2 else 0.0
        self._buffer.insert(0, steer)
        angle, limit = float(self.x[6]), self._car.delta_max_rad
        rate = math.copysign(3.2, acting - angle) if abs(acting - angle) > 1e-4 else 0.0
        rate = (float(np.clip(angle + rate * STEP_S, -limit, limit)) - angle) / STEP_S
        v = math.hypot(self.x[3], self.x[4])
        off = speed - v
        gain = (10.0 if v > 0 else 2.0) * A_MAX / (V_MAX if off > 0 else -V_MIN)
        a = float(np.clip(gain * off, -A_MAX, A_MAX * min(1.0, 7.319 / max(v, 7.319))))
        self.x = self._next(self.x, np.array([a, rate]))
        return self._observation(), STEP_S, self.collides, {}

    def _observation(self) -> dict[str, Any]:
        x = self.x
        return {
            "ego_idx": 0, "scans": [np.zeros(1080)],
            "poses_x": [x[0]], "poses_y": [x[1]], "poses_theta": [x[2]],
            "linear_vels_x": [math.hypot(x[3], x[4])], "linear_vels_y": [0.0],
            "ang_vels_z": [x[5]], "collisions": np.array([float(self.collides)]),
            "lap_times": np.zeros(1), "lap_counts": np.zeros(1),
        }  # fmt: skip
