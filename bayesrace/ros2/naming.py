"""Names and bytes of rmw_zenoh, as ROS 2 Jazzy (from its release 0.2.4) and Kilted have it."""

import struct
from typing import Final, NamedTuple

__all__ = ["Topic", "attachment", "token"]

_ATTACHMENT: Final = struct.Struct("<qqB16s")
_QOS: Final = {False: "::,10:,:,:,,", True: ":1:,1:,:,:,,"}
"""By whether it is latched: reliability, durability (1: transient local), history and its depth,
deadline, lifespan, liveliness; empty ones are reliable, volatile, keep last, and none."""


class Topic(NamedTuple):
    """A fully qualified topic, as ``/tf``, its type, as ``tf2_msgs/msg/TFMessage``, and the hash of
    that, RIHS01_ and 64 hexadecimal digits."""

    name: str
    kind: str
    type_hash: str

    @property
    def type_parts(self) -> str:
        """Type as DDS names it, and hash."""
        package, folder, name = self.kind.split("/")
        return f"{package}::{folder}::dds_::{name}_/{self.type_hash}"

    def key(self, domain_id: int) -> str:
        """Key expression of its messages."""
        return f"{domain_id}/{self.name.strip('/')}/{self.type_parts}"


def token(
    session: str, domain_id: int, node: str, entity: str = "NN", number: int = 0,
    topic: Topic | None = None, latched: bool = False,
) -> str:  # fmt: skip
    """Key expression of a liveliness token: of a node (``/namespace/name``), or of its publisher
    ("MP") or subscription ("MS") with that number within the session."""
    namespace, _, name = node.rpartition("/")
    where = f"{(namespace or '/').replace('/', '%')}/{name}"
    text = f"@ros2_lv/{domain_id}/{session}/0/{number}/{entity}/%/{where}"
    if topic is None:
        return text
    return f"{text}/{topic.name.replace('/', '%')}/{topic.type_parts}/{_QOS[latched]}"


def attachment(number: int, time_ns: int, gid: bytes) -> bytes:
    """Of a message: its number, from 1, calendar time, and the publisher's 16 bytes of identity."""
    return _ATTACHMENT.pack(number, time_ns, len(gid), gid)
