"""The well-known schemas of Foxglove that a scene needs, as JSON.

Each has the fields that its JSON form requires, with their defaults; times are seconds and
nanoseconds, lengths metres, colours shares from 0 to 1.
"""

from collections.abc import Callable
from functools import cache
from types import GenericAlias
from typing import Any, Final

import msgspec
from msgspec import Struct

__all__ = [
    "LINE_LOOP", "LINE_STRIP", "Color", "Duration", "FrameTransform", "FrameTransforms", "Line",
    "Log", "Pose", "PoseInFrame", "Quaternion", "SceneEntity", "SceneUpdate", "Time", "Triangles",
    "Vector3", "schema_name", "schema_text",
]  # fmt: skip

LINE_STRIP: Final = 0
LINE_LOOP: Final = 1


def _schema(name: str, /, **fields: Any) -> Callable[..., Struct]:
    """A structure: of each field, the type, or type and default."""
    listed = [(field, *(of if isinstance(of, tuple) else (of,))) for field, of in fields.items()]
    return msgspec.defstruct(name, listed, frozen=True, gc=False, module=__name__)


def _list(of: Any) -> Any:
    return GenericAlias(list, (of,))


Time = _schema("Time", sec=int, nsec=int)
Duration = _schema("Duration", sec=(int, 0), nsec=(int, 0))
Vector3 = _schema("Vector3", x=(float, 0.0), y=(float, 0.0), z=(float, 0.0))
Quaternion = _schema("Quaternion", x=(float, 0.0), y=(float, 0.0), z=(float, 0.0), w=(float, 1.0))
Color = _schema("Color", r=float, g=float, b=float, a=(float, 1.0))
Pose = _schema("Pose", position=(Vector3, Vector3()), orientation=(Quaternion, Quaternion()))
FrameTransform = _schema(
    "FrameTransform",
    timestamp=Time, parent_frame_id=str, child_frame_id=str, translation=Vector3,
    rotation=Quaternion,
)  # fmt: skip
FrameTransforms = _schema("FrameTransforms", transforms=_list(FrameTransform))
PoseInFrame = _schema("PoseInFrame", timestamp=Time, frame_id=str, pose=Pose)
Log = _schema(
    "Log", timestamp=Time, level=int, message=str, name=str, file=(str, ""), line=(int, 0)
)

_drawn: Final = {
    "color": Color, "points": _list(Vector3), "colors": (_list(Color), []),
    "indices": (_list(int), []), "pose": (Pose, Pose()),
}  # fmt: skip
Line = _schema("LinePrimitive", type=int, thickness=float, scale_invariant=bool, **_drawn)
Triangles = _schema("TriangleListPrimitive", **_drawn)
_Unused = _schema("Unused")
"""Of a kind that no scene has one of."""
_NONE: Final[Any] = _list(_Unused), []
SceneEntity = _schema(
    "SceneEntity",
    timestamp=Time, frame_id=str, id=str, lifetime=(Duration, Duration()),
    frame_locked=(bool, False), lines=(_list(Line), []), triangles=(_list(Triangles), []),
    metadata=_NONE, arrows=_NONE, cubes=_NONE, spheres=_NONE, cylinders=_NONE, texts=_NONE,
    models=_NONE,
)  # fmt: skip
SceneUpdate = _schema("SceneUpdate", entities=_list(SceneEntity), deletions=_NONE)


def schema_name(kind: type[Struct]) -> str:
    """By which viewers know a schema."""
    return f"foxglove.{kind.__name__}"


@cache
def schema_text(kind: type[Struct]) -> bytes:
    """Its JSON schema, without references, which viewers do not follow."""
    known = msgspec.json.schema(kind)["$defs"]

    def written_out(part: Any) -> Any:
        if isinstance(part, list):
            return [written_out(one) for one in part]
        if not isinstance(part, dict):
            return part
        if "$ref" in part:
            return written_out(known[part["$ref"].rpartition("/")[2]])
        plain = {key: written_out(one) for key, one in part.items() if key != "default"}
        if "properties" in plain:  # whole messages are written
            plain["required"] = list(plain["properties"])
        if plain.get("title") in ("Time", "Duration"):  # so viewers tell them from other objects
            plain["title"] = plain["title"].lower()
        return plain

    return msgspec.json.encode(written_out(known[kind.__name__]))
