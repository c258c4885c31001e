"""ROS messages, made of maps and of our numbers."""

import math
import time
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import Car

__all__ = ["TYPES", "drive_fields", "header", "heading_of", "made", "planar_pose"]

TYPES: Final = get_typestore(Stores.ROS2_JAZZY)
"""Those that we use are the same in Kilted."""
_DRIVE: Final = "steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk"
for _name, _text in {  # not part of a ROS installation
    "AckermannDrive": "".join(f"float32 {one}\n" for one in _DRIVE),
    "AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}.items():
    TYPES.register(get_types_from_msg(_text, f"ackermann_msgs/msg/{_name}"))

_LEAST_NORM: Final = 1e-3
"""Squared, of an orientation."""


def made(kind: str, **given: Any) -> Any:
    """A message of that type, nested ones as maps; what is not given is zero or empty."""
    fields = TYPES.fielddefs[kind][1]
    return TYPES.types[kind](
        **{name: _value(node, of, given.get(name)) for name, (node, of) in fields}
    )


def _value(node: Nodetype, of: Any, given: Any) -> Any:
    if node is Nodetype.NAME:
        return made(of, **(given or {}))
    if node is Nodetype.BASE:
        return given or {"string": "", "bool": False}.get(of[0], 0)
    (inner, kind), length = of
    if inner is Nodetype.NAME:
        return [made(kind, **one) for one in given or ()]
    if kind[0] == "string":
        return given or []
    return np.zeros(length, kind[0]) if given is None else np.asarray(given, kind[0])


def header(frame: str) -> dict[str, Any]:
    """With the calendar time of now."""
    sec, nanosec = divmod(time.time_ns(), 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def planar_pose(x: float, y: float, psi: float, ahead_m: float = 0.0) -> dict[str, Any]:
    """Of the point ``ahead_m`` of this one."""
    at = {"x": x + ahead_m * math.cos(psi), "y": y + ahead_m * math.sin(psi)}
    return {"position": at, "orientation": {"z": math.sin(psi / 2), "w": math.cos(psi / 2)}}


def heading_of(q: Any) -> float:
    """The heading in an orientation; InputError if that is no quaternion."""
    if not q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w >= _LEAST_NORM:
        raise InputError("an orientation that is no quaternion")
    return math.atan2(2 * (q.w * q.z + q.x * q.y), q.w**2 + q.x**2 - q.y**2 - q.z**2)


def drive_fields(
    car: Car, frame: str, lead_s: float, vx_mps: float, d: float, delta_rad: float, rate: float
) -> dict[str, Any]:
    """Of an AckermannDriveStamped: a drive command as acceleration, and as the speed that it leads
    to in ``lead_s``; and the steering angle to go to, at that rate [rad/s]."""
    # The command is linear in the acceleration.
    rest, unit = (car.drive.command_at(vx_mps, a, car.mass_kg) for a in (0.0, 1.0))
    acceleration = (d - rest) / (unit - rest)
    speed = max(vx_mps + lead_s * acceleration, 0.0)
    drive = dict(zip(_DRIVE, (delta_rad, rate, speed, acceleration), strict=False))
    return {"header": header(frame), "drive": drive}
