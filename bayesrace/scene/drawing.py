"""The scene of a run: track, start and racing line; each car with its plan, and how far it may be
off that; a log of what has happened."""

import math
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from bayesrace.messages import END_REASONS, CarSample, Event, Message, State, Status, Telemetry
from bayesrace.scene import schemas
from bayesrace.scene.schemas import Color, Quaternion, SceneEntity, SceneUpdate, Time, Vector3

if TYPE_CHECKING:
    from bayesrace.raceline import RaceLine
    from bayesrace.tracks import Track
    from bayesrace.vehicles import Car

__all__ = ["SCENE", "Drawn", "Scene"]

SCENE: Final = "scene/"
"""What the topics of a scene begin with, and no key of a message does."""
_WORLD: Final = "world"

_PERIOD_NS: Final = 39_000_000
"""From one pose of a frame, or plan, to the next, at least: 25 Hz of car time."""
_PLAN_LIVES: Final = schemas.Duration(0, 500_000_000)
_MOST_POINTS: Final = 400
"""Of an edge or a line."""

_GREY, _INK = Color(0.55, 0.55, 0.52), Color(0.95, 0.95, 0.95)
_SURFACE: Final = Color(0.35, 0.35, 0.35, 0.35)
_SLOW, _FAST = np.array([0.2, 0.35, 0.9]), np.array([0.99, 0.91, 0.14])
_COLOURS: Final = (
    (0.9, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.8, 0.47, 0.65), (0.84, 0.37, 0.0),
)  # fmt: skip
"""Of cars and shadows in the order in which they appear: Okabe and Ito's, for all eyes."""

_INFO, _WARNING, _ERROR = 2, 3, 4
_WARNED: Final = {
    "hold_lost", "sensor_fault", "suspended", "weights_not_kept", "weights_refused",
    "weights_rolled_back",
}  # fmt: skip
"""Kinds of events."""
_REGULAR: Final = END_REASONS[:3]

_encode: Final = msgspec.json.Encoder().encode


class Drawn(NamedTuple):
    """A message for viewers; its class is one of :mod:`bayesrace.scene.schemas`."""

    topic: str
    message: Struct

    @property
    def json(self) -> bytes:
        """As it is written and sent."""
        return _encode(self.message)


class Scene:
    """Makes messages for viewers of the messages of a run, in their order. One thread only.

    A car is a frame of its name, where it is measured or estimated; ``{car}/truth`` is where a
    simulated car is, if that differs. A shadow has a plan of its own, and with an estimate a frame,
    ``{car}/{shadow}``.
    """

    def __init__(
        self,
        car: "Car",
        track: "Track | None" = None,
        line: "RaceLine | None" = None,
        name: str = "",
    ) -> None:
        """``name``: the car's in the network, for the layout; that of its file if empty."""
        self._size, self._name = (car.length_m, car.width_m), name or car.name
        self._fixed = _track_parts(track) + _line_parts(line)
        self._colours: dict[str, tuple[float, ...]] = {}
        self._phases: dict[str, str] = {}
        self._measured: dict[str, tuple[float, ...]] = {}
        self._last_ns: dict[str, int] = {}
        self._drawn: set[str] = set()
        """Frames whose outline is drawn, and the world."""

    def begin(self) -> None:
        """What is constant is drawn again with the next message: for a new file, or viewer."""
        self._drawn.clear()

    @property
    def layout(self) -> bytes:
        """Panels of Foxglove and Lichtblick for the car and its scene, as JSON."""
        text = files("bayesrace.scene").joinpath("layout.json").read_text()
        return text.replace("{car}", self._name).encode()

    def of(self, key: str, message: Message, time_ns: int) -> Iterator[Drawn]:
        """What a message on ``key`` changes. ``time_ns``: of the scene, since 1970; in a log, car
        time (:class:`bayesrace.log_clock.CarClock`)."""
        parts, now = key.split("/"), Time(*divmod(time_ns, 1_000_000_000))
        car = parts[1]
        if _WORLD not in self._drawn:
            self._drawn.add(_WORLD)
            entities = [SceneEntity(now, _WORLD, *part) for part in self._fixed]
            yield Drawn(f"{SCENE}track", SceneUpdate(entities))
        if isinstance(message, CarSample):
            if frame := self._frame(car, message):
                yield from self._moved(frame, message.x, now, time_ns)
        elif isinstance(message, Telemetry):
            frame = f"{car}/{parts[3]}" if len(parts) > 3 else car  # behind 'shadow', its name
            if message.estimate:
                yield from self._moved(frame, message.estimate, now, time_ns)
            if message.plan_x and self._due(f"{frame} plan", time_ns):
                yield Drawn(f"{SCENE}{frame}/plan", self._plan(frame, message, now))
        elif isinstance(message, Event | Status) and (news := self._news(key, message)):
            yield Drawn(f"{SCENE}{car}/log", schemas.Log(now, *news, message.source))

    def _frame(self, car: str, sample: CarSample) -> str:
        """That it places; none if it says nothing, or the truth is what was measured."""
        if isinstance(sample, State):
            self._measured[car] = () if sample.estimated else sample.x
            return "" if sample.estimated else car
        return "" if sample.x == self._measured.get(car) else f"{car}/truth"

    def _news(self, key: str, message: Event | Status) -> tuple[int, str] | None:
        """Level and text of what is new in it."""
        if isinstance(message, Event):
            return _level(message), f"{message.kind}: {message.text}"
        if self._phases.get(key) == message.phase:
            return None
        self._phases[key] = message.phase
        return _WARNING if message.phase == "fallback" else _INFO, f"phase: {message.phase}"

    def _moved(
        self, frame: str, x: tuple[float, ...], now: Struct, time_ns: int
    ) -> Iterator[Drawn]:
        if frame not in self._drawn:
            self._drawn.add(frame)
            yield Drawn(f"{SCENE}{frame}/car", self._outline(frame, now))
        if self._due(frame, time_ns):
            at = Vector3(round(x[0], 4), round(x[1], 4))
            turned = Quaternion(z=round(math.sin(x[2] / 2), 4), w=round(math.cos(x[2] / 2), 4))
            moved = schemas.FrameTransform(now, _WORLD, frame, at, turned)
            yield Drawn(f"{SCENE}{frame}/transform", schemas.FrameTransforms([moved]))
            pose = schemas.PoseInFrame(now, _WORLD, schemas.Pose(at, turned))
            yield Drawn(f"{SCENE}{frame}/pose", pose)

    def _due(self, name: str, time_ns: int) -> bool:
        last_ns = self._last_ns.get(name)
        if last_ns is not None and 0 <= time_ns - last_ns < _PERIOD_NS:
            return False
        self._last_ns[name] = time_ns
        return True

    def _colour(self, frame: str, opacity: float) -> Struct:
        """Of a frame; that of the truth is its car's."""
        colours, name = self._colours, frame.removesuffix("/truth")
        colours.setdefault(name, _COLOURS[len(colours) % len(_COLOURS)])
        return Color(*colours[name], opacity)

    def _outline(self, frame: str, now: Struct) -> Struct:
        """Seen from above: a box whose front comes to a point."""
        along, across = self._size[0] / 2, self._size[1] / 2
        bend = 0.4 * along
        right, left = (((-along, -y), (bend, -y), (along, 0.0)) for y in (across, -across))
        colour = self._colour(frame, 0.4 if "/" in frame else 1.0)
        body = _band(right, left, colour, 0.004)
        entity = SceneEntity(now, frame, "car", triangles=[body], frame_locked=True)
        return SceneUpdate([entity])

    def _plan(self, frame: str, cycle: Telemetry, now: Struct) -> Struct:
        """The planned way, and by how much to either side the car may be off it."""
        plan, tube = np.array(cycle.plan_x).reshape(-1, 7), np.array((0.0, *cycle.tube_m))
        if len(tube) != len(plan):
            tube = np.zeros(len(plan))
        xy, psi = plan[:, :2], plan[:, 2]
        off = np.array((np.sin(psi), -np.cos(psi))).T * tube[:, None]
        # At once: this is most of what a cycle costs.
        way, right, left = np.array((xy, xy + off, xy - off)).round(3).tolist()
        areas = [_band(right, left, self._colour(frame, 0.4), 0.002)] if tube.any() else []
        lines = [_line(way, self._colour(frame, 1.0), 3.0, 0.003)]
        return SceneUpdate([SceneEntity(now, _WORLD, "plan", _PLAN_LIVES, False, lines, areas)])


def _level(event: Event) -> int:
    if event.kind == "run_ended":
        return _INFO if event.data.get("reason") in _REGULAR else _ERROR
    if event.kind == "recorder_failed":
        return _ERROR
    return _WARNING if event.kind in _WARNED else _INFO


_Points = Sequence[Sequence[float]]
"""x, y of each."""


@cache
def _strip(count: int) -> list[int]:
    """Two triangles between each of ``count`` pairs of vertices and the next."""
    return [2 * i + k for i in range(count - 1) for k in (0, 1, 2, 1, 3, 2)]


def _band(right: _Points, left: _Points, colour: Struct, z: float) -> Struct:
    """The area between two edges."""
    points = [Vector3(x, y, z) for pair in zip(right, left, strict=True) for x, y in pair]
    return schemas.Triangles(colour, points, [], _strip(len(right)))


def _line(
    way: _Points, colour: Struct, width_px: float, z: float, loop: bool = False, colours: Any = ()
) -> Struct:
    kind = schemas.LINE_LOOP if loop else schemas.LINE_STRIP
    points = [Vector3(x, y, z) for x, y in way]
    return schemas.Line(kind, width_px, True, colour, points, list(colours))


def _track_parts(track: "Track | None") -> list[tuple[Any, ...]]:
    """Its entity but for time and frame: surface, edges and start."""
    if track is None:
        return []
    edges = track.boundaries(max(0.02, track.length_m / _MOST_POINTS))
    right, left = (edge.round(3).tolist() for edge in edges)
    lines = [_line(edge, _GREY, 2.0, 0.0, loop=True) for edge in (right, left)]
    lines.append(_line((right[0], left[0]), _INK, 4.0, 0.001))
    surface = _band([*right, right[0]], [*left, left[0]], _SURFACE, -0.001)
    return [("track", schemas.Duration(), False, lines, [surface])]


def _line_parts(line: "RaceLine | None") -> list[tuple[Any, ...]]:
    """The same of the racing line, by its speed from blue to yellow."""
    if line is None:
        return []
    thin = slice(None, None, -(-len(line.s_m) // _MOST_POINTS))
    speed = line.vx_mps[thin, None]
    share = (speed - speed.min()) / max(float(np.ptp(speed)), 1e-9)
    colours = [Color(*one) for one in (_SLOW + share * (_FAST - _SLOW)).round(2).tolist()]
    way = _line(line.xy_m[thin].round(3).tolist(), _INK, 2.0, 0.0, loop=True, colours=colours)
    return [("line", schemas.Duration(), False, [way])]
