"""The car of an F1TENTH gym, driven by bayesrace-controller over UDP. See README.md.

    python f1tenth_gym_plant.py track.csv --map maps/track --laps 2

Needs f110_gym 0.2, whose interface it is written for: ``reset(poses)``, ``step(actions)``.
"""

import math
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from python_plant import StartLine, arguments, clip, plant_of

STEER_MAX_RAD, STEER_RATE_RADPS = 0.4189, 3.2
A_MAX, V_MAX, V_MIN = 9.51, 20.0, -5.0
LATE = 2  # steps by which the gym's steering is late
DEVIATION = {"x": 1e-3, "y": 1e-3, "psi": 2e-3, "vx": 0.03, "omega": 0.02, "delta": 0.02}


def speed_for(a: float, v: float) -> float:
    """The desired speed at which the gym's speed controller accelerates by ``a`` at speed ``v``."""
    gain = (10.0 if v > 0 else 2.0) * A_MAX / (V_MAX if a > 0 else -V_MIN)
    return v + a / gain


class GymCar:
    """Inputs: acceleration and steering rate become the gym's steering angle and speed.

    State: the gym shows neither lateral speed nor steering angle. The latter follows from what was
    commanded; the former is the controller's to estimate, so readings are sent.
    """

    step_s = 0.01

    def __init__(self, env: Any, pose: Sequence[float]) -> None:
        self.env = env
        self.angle = self.delta = 0.0  # commanded, and where the gym's servo is
        self.waiting = deque([0.0] * LATE)
        self.observe(env.reset(np.array([pose]))[0])

    def observe(self, seen: Mapping[str, Any]) -> None:
        """Takes the observation of the first car."""
        names = "poses_x poses_y poses_theta linear_vels_x linear_vels_y ang_vels_z"
        self.x = [float(seen[name][0]) for name in names.split()] + [self.delta]
        if seen["collisions"][0]:
            sys.exit("the car has hit something")

    def measured(self, time_s: float) -> dict[str, Any]:
        """What the state message says of the car."""
        x, y, psi, vx, _, omega, delta = self.x
        seen = {"x": x, "y": y, "psi": psi, "vx": vx, "omega": omega, "delta": delta}
        values = {name: [value, DEVIATION[name]] for name, value in seen.items()}
        reading = {"instrument": "gym", "time_s": time_s, "values": values}
        return {"x": [0.0] * 7, "estimated": True, "readings": [reading]}

    def step(self, d: float, rate: float) -> tuple[float, float]:
        """One step of the gym; acceleration and steering rate that act in it."""
        v = self.x[3]
        d = clip(d, -A_MAX * clip(v / 0.5, 0.0, 1.0), A_MAX)  # brakes do not reverse
        rate = clip(rate, -STEER_RATE_RADPS, STEER_RATE_RADPS)
        self.angle = clip(self.angle + rate * self.step_s, -STEER_MAX_RAD, STEER_MAX_RAD)
        # The command acts LATE steps later, and is where the wheels are to be then.
        ahead = self.angle + rate * LATE * self.step_s
        steer = clip(ahead, -STEER_MAX_RAD, STEER_MAX_RAD)
        seen, *_ = self.env.step(np.array([[steer, speed_for(d, v)]]))
        self.waiting.append(steer)
        before, off = self.delta, self.waiting.popleft() - self.delta
        if abs(off) > 1e-4:  # its servo knows full speed and rest
            moved = before + math.copysign(STEER_RATE_RADPS * self.step_s, off)
            self.delta = clip(moved, -STEER_MAX_RAD, STEER_MAX_RAD)
        self.observe(seen)
        return d, (self.delta - before) / self.step_s


if __name__ == "__main__":
    import gym

    parser = arguments()
    parser.add_argument("--map", required=True, help="the gym's map, without .yaml")
    parser.add_argument("--ending", default=".png", help="of the map's picture")
    given = parser.parse_args()
    line = StartLine(given.track)
    env = gym.make("f110_gym:f110-v0", map=given.map, map_ext=given.ending, num_agents=1)
    plant_of(given, GymCar(env, line.pose), line).drive(given.laps)
