"""A car that speaks ROS 2 as the hardware of the plant (docs/ros2.md): poses, odometry, inertial
unit and wheels are its instruments, and it gets AckermannDriveStamped."""

import math
import queue
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.plant.hardware import Hardware, Report
from bayesrace.ros2.node import Node
from bayesrace.ros2.settings import Ros2Settings
from bayesrace.ros2.types import drive_fields, heading_of, planar_pose
from bayesrace.vehicles import Car

__all__ = ["Ros2Car"]

Values = dict[str, tuple[float, float]]
_YEAR_S: Final = 3e7
_AGREEING_S: Final = 10


class Ros2Car(Hardware):
    """The car behind a node."""

    def __init__(self, car: Car, node: Node, settings: Ros2Settings, rate_hz: float = 50.0) -> None:
        own = self._own = settings.car
        super().__init__(car, rate_hz, {str(k): v for k, v in own.delays_s.items()}, own.command_s)
        self._settings = settings
        self._arrived: queue.SimpleQueue[Report] = queue.SimpleQueue()
        self._first_ns: dict[str, int] = {}
        self._odd_ns: dict[str, int] = {}
        """Newest stamps that are years from those before."""
        read: tuple[tuple[str, str, str, Callable[[Any], Values]], ...] = (
            ("pose", own.pose, "geometry_msgs/msg/PoseStamped", self._pose),
            ("odometry", own.odometry, "nav_msgs/msg/Odometry", self._odometry),
            ("imu", own.imu, "sensor_msgs/msg/Imu", self._imu),
            ("wheels", own.wheels, "sensor_msgs/msg/JointState", self._wheels),
        )
        for instrument, topic, kind, values in read:
            if topic:
                node.subscribe(topic, kind, partial(self._take, instrument, values))
        self._drive = node.publisher(own.drive, "ackermann_msgs/msg/AckermannDriveStamped")

    def receive(self) -> Report | None:
        """The next message, as a report."""
        try:
            return self._arrived.get(timeout=0.1)
        except queue.Empty:
            return None

    def send(self, d: float, delta_rad: float, rate_radps: float) -> None:
        """The command as steering angle, speed and acceleration."""
        of = self.car, self._settings.car_frame, self._settings.speed_lead_s, float(self.x[3])
        self._drive(lambda: drive_fields(*of, d, delta_rad, rate_radps))

    def _take(self, instrument: str, values: Callable[[Any], Values], message: Any) -> None:
        found, stamp = values(message), message.header.stamp
        # Counted from the instrument's first one: calendar times are too large. 0: not set.
        clock_s = None
        if time_ns := stamp.sec * 10**9 + stamp.nanosec:
            clock_s = (time_ns - self._first_ns.setdefault(instrument, time_ns)) * 1e-9
            if abs(clock_s) > _YEAR_S:  # damaged; or the sender's clock has been set: two say so
                before_ns, self._odd_ns[instrument] = self._odd_ns.get(instrument, 0), time_ns
                clock_s = None
                if abs(time_ns - before_ns) < 10**9 * _AGREEING_S:
                    self._first_ns[instrument], clock_s = time_ns, 0.0
        self._arrived.put(Report(instrument, found, clock_s))

    def _pose(self, message: Any) -> Values:
        if (frame := message.header.frame_id) != self._settings.world_frame:
            raise InputError(f"frame '{frame}' is not world_frame '{self._settings.world_frame}'")
        return self._placed(message.pose, (0.0, 0.0, 0.0))

    def _placed(self, pose: Any, variances: tuple[float, ...]) -> Values:
        """Of the centre of gravity."""
        at, psi, own = pose.position, heading_of(pose.orientation), self._own
        at = planar_pose(at.x, at.y, psi, self._settings.centre_ahead_m)["position"]
        deviations = map(_deviation, variances, (own.position_m, own.position_m, own.heading_rad))
        named = zip(("x", "y", "psi"), (at["x"], at["y"], psi), deviations, strict=True)
        return {name: (value, deviation) for name, value, deviation in named}

    def _odometry(self, message: Any) -> Values:
        """Its speed; and its pose if that is in the world, not since the start."""
        twist, pose = message.twist, message.pose
        values = {
            "vx": (twist.twist.linear.x, _deviation(twist.covariance[0], self._own.speed_mps))
        }
        if message.header.frame_id == self._settings.world_frame:
            values |= self._placed(pose.pose, pose.covariance[[0, 7, 35]])
        return values

    def _imu(self, message: Any) -> Values:
        covariance = message.angular_velocity_covariance
        if covariance[0] == -1:  # so says the message's definition
            raise InputError("it does not measure the yaw rate")
        deviation = _deviation(covariance[8], self._own.yaw_rate_radps)
        return {"omega": (message.angular_velocity.z, deviation)}

    def _wheels(self, message: Any) -> Values:
        speeds = dict(zip(message.name, message.velocity, strict=True))
        wanted = self._own.wheel_joints or tuple(speeds)
        mean = sum(speeds[one] for one in wanted) / len(wanted)
        return {"vx": (float(mean) * self._own.wheel_radius_m, self._own.speed_mps)}


def _deviation(variance: float, usual: float) -> float:
    """Zero stands for unknown."""
    return math.sqrt(variance) if variance > 0 else usual
