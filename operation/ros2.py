"""A car of our network, shown to a ROS 2 network; and a joystick there that stops it.

The two networks have a session each, and nothing is forwarded but what is made here.
"""

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.messages import ACTUATION, COMMAND, STATE, TELEMETRY, Actuation, State, Telemetry
from bayesrace.messages import Command as StopOrGo
from bayesrace.ros2.node import Node, open_node
from bayesrace.ros2.settings import Joy, Ros2Settings
from bayesrace.ros2.types import drive_fields, header, planar_pose
from bayesrace.tracks import Track, load_track
from bayesrace.transport import Endpoints, Inbox, Kind, ask, open_session
from bayesrace.vehicles import Car

__all__ = ["Buttons", "View", "bridge"]

_log = logging.getLogger("bayesrace.ros2")

_NEWEST: Final = 2
"""Messages that wait: who only looks needs no older ones."""
_COMMAND_S: Final = 2.0
_LINE_STRIP: Final = 4
_LINE: Final = 0.1
"""Width of lines in widths of the car."""
_LONGEST_S: Final = 1.0
"""Period of a plant."""
_SHOWN_NS: Final = 500_000_000
"""How long a tube is shown if no other follows."""


def bridge(
    endpoints: Endpoints, settings: Ros2Settings, car: Car, name: str, track: str, joy: bool
) -> None:
    """Publishes what the car does until SIGINT or SIGTERM; ``joy``: buttons stop it, and let it go.

    ``track``: empty: none. Raises InputError at what cannot be used, and without a router of ROS.
    """
    name = endpoints.car_named(name) or car.name
    course = load_track(track, car.width_m) if track else None
    with (
        open_session(endpoints, "director" if joy else "viewer") as session,
        open_node(settings, "bridge") as node,
        ThreadPoolExecutor(4) as pool,
    ):
        view = View(node, settings, car, course)
        if joy:
            buttons = Buttons(settings.joy, pool, partial(_command, session, name))
            node.subscribe(settings.joy.topic, "sensor_msgs/msg/Joy", buttons)
        inbox = Inbox(session, name)
        inbox.subscribe(STATE, newest=_NEWEST, logger=_log)
        inbox.subscribe(ACTUATION, newest=_NEWEST, logger=_log)
        inbox.subscribe(TELEMETRY, newest=_NEWEST, logger=_log)
        _log.info("car '%s' for the ROS network at %s", name, settings.endpoint)
        with inbox.receive_signals():
            while (item := inbox.get(1.0)) is None or item.kind is not Kind.SIGNAL:
                if item is not None and item.value is not None:
                    view.show(item.value)
        _log.info("%d messages of the ROS network refused", node.refused)


def _command(session: Any, name: str, action: str) -> None:
    now_ns = time.monotonic_ns()
    request = StopOrGo(seq=0, source_time_ns=now_ns, command=action, text="joystick of ROS")
    try:
        answer = ask(session, COMMAND, name, request, timeout_s=_COMMAND_S).text
    except InputError as error:
        answer = str(error)
    _log.warning("%s by joystick: %s", action, answer)


class Buttons:
    """Turns the pressing of buttons into commands, whose answers ``pool`` waits for. Stop wins."""

    def __init__(self, settings: Joy, pool: Executor, command: Callable[[str], None]) -> None:
        self._settings, self._pool, self._command = settings, pool, command
        self._stop, self._go = False, True
        """Before the first message: a stop that is held then counts, a go does not."""
        self._stops = 0
        self._going: Future[None] | None = None

    def __call__(self, message: Any) -> None:
        """A message of the joystick; IndexError if it lacks a button."""
        stop = bool(message.buttons[self._settings.stop_button])
        go = bool(message.buttons[self._settings.go_button]) and not stop
        pressed = "stop" if stop and not self._stop else "go" if go and not self._go else ""
        self._stop, self._go = stop, go
        if pressed == "stop":
            self._stops += 1
            self._pool.submit(self._command, pressed)
        elif pressed and (self._going is None or self._going.done()):
            self._going = self._pool.submit(self._send_go, self._stops)

    def _send_go(self, stops: int) -> None:
        """Unless the car is stopped first; again where it was meanwhile, as the go may be late."""
        if stops == self._stops:
            self._command("go")
            if stops != self._stops:
                self._command("stop")


class View:
    """Makes ROS messages of ours."""

    def __init__(self, node: Node, settings: Ros2Settings, car: Car, track: Track | None) -> None:
        self._settings, self._car = settings, car
        self._x: Floats | None = None
        self._time_s = self._step_s = 0.0
        to, markers = settings.publish, "visualization_msgs/msg/MarkerArray"
        drive = "ackermann_msgs/msg/AckermannDriveStamped"
        self._odometry = node.publisher(to.odometry, "nav_msgs/msg/Odometry", to.state_hz)
        self._tf = node.publisher(to.tf, "tf2_msgs/msg/TFMessage", to.state_hz)
        self._drive = node.publisher(to.drive, drive, to.drive_hz)
        self._plan = node.publisher(to.plan, "nav_msgs/msg/Path", to.plan_hz)
        self._tube = node.publisher(to.tube, markers, to.plan_hz)
        if track is not None:
            edges = [np.vstack((one, one[:1])) for one in track.boundaries(car.width_m)]
            latched = node.publisher(to.track, markers, latched=True)
            latched(lambda: self._lines("track", edges, (0.8, 0.8, 0.8)))

    def show(self, message: State | Actuation | Telemetry) -> None:
        """Publishes what follows from it, as often as it may."""
        match message:
            case State():
                step_s, self._time_s = message.time_s - self._time_s, message.time_s
                self._step_s = step_s if 0 < step_s <= _LONGEST_S else 0.0  # of another run
                if not message.estimated:
                    self._moved(message.x, np.zeros(7))
            case Telemetry():
                if message.estimate and message.deviation:
                    self._moved(message.estimate[:7], np.array(message.deviation[:7]))
                if message.plan_x:
                    plan = np.reshape(message.plan_x, (-1, 7))
                    self._plan(lambda: self._path(plan))
                    self._tube(lambda: self._sides(plan[1:], np.array(message.tube_m)))
            case Actuation() if self._x is not None:
                (d, rate), vx_mps, delta_rad = message.u, self._x[3], self._x[6]
                of = self._car, self._settings.car_frame, self._settings.speed_lead_s, vx_mps
                delta_rad += rate * self._step_s
                self._drive(lambda: drive_fields(*of, d, delta_rad, rate))

    def _moved(self, x: Sequence[float], deviation: Floats) -> None:
        """Odometry and transform are of the car frame's origin; variances of 0 are unknown."""
        self._x = np.array(x)
        settings, ahead_m = self._settings, self._settings.centre_ahead_m
        of = {"header": header(settings.world_frame), "child_frame_id": settings.car_frame}
        at = planar_pose(x[0], x[1], x[2], -ahead_m)
        variances = np.zeros((2, 36))
        variances[:, [0, 7, 35]] = (deviation[:6] ** 2).reshape(2, 3)
        moves = {"linear": {"x": x[3], "y": x[4] - ahead_m * x[5]}, "angular": {"z": x[5]}}
        pose = {"pose": at, "covariance": variances[0]}
        twist = {"twist": moves, "covariance": variances[1]}
        transform = {"translation": at["position"], "rotation": at["orientation"]}
        self._odometry(lambda: {**of, "pose": pose, "twist": twist})
        self._tf(lambda: {"transforms": [{**of, "transform": transform}]})

    def _path(self, plan: Floats) -> dict[str, Any]:
        """Of the centre of gravity, as the plan is."""
        head = header(self._settings.world_frame)
        poses = [{"header": head, "pose": planar_pose(*row[:3])} for row in plan.tolist()]
        return {"header": head, "poses": poses}

    def _sides(self, plan: Floats, tube_m: Floats) -> dict[str, Any]:
        """Both sides of the tube along the plan."""
        count = min(len(plan), len(tube_m))
        plan, tube_m = plan[:count], tube_m[:count]
        aside = tube_m[:, None] * np.stack((-np.sin(plan[:, 2]), np.cos(plan[:, 2])), axis=1)
        sides = plan[:, :2] - aside, plan[:, :2] + aside
        return self._lines("tube", sides, (0.1, 0.5, 1.0), lifetime={"nanosec": _SHOWN_NS})

    def _lines(
        self, name: str, lines: Sequence[Floats], rgb: tuple[float, float, float], **more: Any
    ) -> dict[str, Any]:
        marker = {
            "header": header(self._settings.world_frame), "ns": name, "type": _LINE_STRIP,
            "pose": planar_pose(0.0, 0.0, 0.0), "scale": {"x": _LINE * self._car.width_m},
            "color": {**dict(zip("rgb", rgb, strict=True)), "a": 1.0}, **more,
        }  # fmt: skip
        points = ([{"x": x, "y": y} for x, y in line.tolist()] for line in lines)
        return {"markers": [{**marker, "id": i, "points": some} for i, some in enumerate(points)]}
