"""A car that speaks ROS 2, simulated, with the router of its network. See README.md.

The car is BayesRace's simulator. It publishes PoseStamped, Odometry and Imu, takes
AckermannDriveStamped, and brakes when none has come for 0.2 s.
"""

import argparse
import json
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.ros2.node import Node, open_node
from bayesrace.ros2.settings import Ros2Settings
from bayesrace.ros2.types import header, planar_pose
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic

STEP_HZ, POSE_HZ = 500, 100
WATCHDOG_S = 0.2


class Car:
    """Actuators, what they move, and what is measured of it."""

    def __init__(self, name: str, track: str, node: Node, settings: Ros2Settings) -> None:
        self.simulator = Simulator(dynamic(get_car(name)), plant_discretisation(STEP_HZ))
        x, y, psi = load_track(track).start_pose()
        ahead_m = 2 * self.simulator.car.wheelbase_m  # of the start line
        self.simulator.reset(
            (x + ahead_m * np.cos(psi), y + ahead_m * np.sin(psi), psi, 0, 0, 0, 0)
        )
        own, self._settings = settings.car, settings
        self._command: Any = None
        self._heard_s = -WATCHDOG_S
        node.subscribe(own.drive, "ackermann_msgs/msg/AckermannDriveStamped", self._on_drive)
        self._pose = node.publisher(own.pose, "geometry_msgs/msg/PoseStamped")
        self._odometry = node.publisher(own.odometry, "nav_msgs/msg/Odometry")
        self._imu = node.publisher(own.imu, "sensor_msgs/msg/Imu")
        self._random = np.random.default_rng(0)

    def _on_drive(self, message: Any) -> None:
        self._command, self._heard_s = message.drive, time.monotonic()

    def step(self) -> None:
        """2 ms: the motor follows the acceleration, the servo the angle at the commanded rate."""
        simulator, drive = self.simulator, self._command
        if drive is None or time.monotonic() - self._heard_s > WATCHDOG_S:
            simulator.step(None)
            return
        d = simulator.car.drive.command_at(
            simulator.x[3], drive.acceleration, simulator.car.mass_kg
        )
        rate = (drive.steering_angle - simulator.x[6]) / simulator.step_s
        most = drive.steering_angle_velocity
        simulator.step((d, min(max(rate, -most), most)))

    def measure(self) -> None:
        """One message of each instrument."""
        own, noise = self._settings.car, self._random.normal
        x, y, psi = noise(self.simulator.x[:3], (own.position_m, own.position_m, own.heading_rad))
        vx = noise(self.simulator.x[3], own.speed_mps)
        omega = noise(self.simulator.x[5], own.yaw_rate_radps)
        world, frame = header(self._settings.world_frame), header(self._settings.car_frame)
        at, turning = planar_pose(x, y, psi), {"z": omega}
        moving = {"twist": {"linear": {"x": vx}}}
        self._pose(lambda: {"header": world, "pose": at})
        self._odometry(lambda: {"header": header("odom"), "twist": moving})
        self._imu(lambda: {"header": frame, "angular_velocity": turning})


def simulate(car: Car, out: Path) -> None:
    """In real time, until SIGTERM; the true states go to a file."""
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, lambda *_: sys.exit(0))
    simulator, start_s = car.simulator, time.monotonic()
    with out.open("w", buffering=1) as truth:
        while True:
            time.sleep(max(start_s + simulator.time_s - time.monotonic(), 0.0))
            if simulator.steps % (STEP_HZ // POSE_HZ) == 0:
                car.measure()
                truth.write(",".join(f"{one:.6g}" for one in simulator.x) + "\n")
            car.step()


def router(endpoint: str) -> Any:
    """What 'ros2 run rmw_zenoh_cpp rmw_zenohd' is in a ROS network."""
    config = zenoh.Config()
    for key, value in {
        "mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False,
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--car", default="orca", help="built-in car, or its file")
    parser.add_argument("--track", default="harbour", help="where it stands, past the start line")
    topics = Path(__file__).with_name("ros2.toml")
    parser.add_argument("--topics", type=Path, default=topics, help="settings (TOML)")
    parser.add_argument("--truth", type=Path, default=Path("truth.csv"), help="true states")
    given = parser.parse_args()
    chosen = Ros2Settings.chosen(given.topics)
    with router(chosen.endpoint), open_node(chosen, "car") as node:
        simulate(Car(given.car, given.track, node, chosen), given.truth)
