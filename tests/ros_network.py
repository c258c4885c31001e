"""A ROS network of rmw_zenoh as far as Zenoh sees it: a router, and a node with literal keys."""

import json
import struct
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
import zenoh.ext

from bayesrace.ros2.types import TYPES, made

__all__ = ["Ros", "network"]


class Ros:
    """A node of a ROS network as far as Zenoh sees it: a peer of the router, with literal keys."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.session = opened("peer", connect=endpoint)
        self.heard: dict[str, list[tuple[Any, bytes]]] = defaultdict(list)
        self._kept: list[Any] = []
        self._sent = 0

    def key(self, topic: str, kind: str) -> str:
        package, _, name = kind.split("/")
        return f"0/{topic}/{package}::msg::dds_::{name}_/{TYPES.hash_rihs01(kind)}"

    def hear(self, topic: str, kind: str, latched: bool = False) -> None:
        def on_sample(sample: Any) -> None:
            message = TYPES.deserialize_cdr(sample.payload.to_bytes(), kind)
            self.heard[topic].append((message, sample.attachment.to_bytes()))

        key = self.key(topic, kind)
        self._kept.append(
            zenoh.ext.declare_advanced_subscriber(
                self.session, key, on_sample, subscriber_detection=True,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            )
            if latched
            else self.session.declare_subscriber(key, on_sample)
        )  # fmt: skip

    def say(self, topic: str, kind: str, **fields: Any) -> None:
        self.send(topic, kind, bytes(TYPES.serialize_cdr(made(kind, **fields), kind)))

    def send(self, topic: str, kind: str, data: bytes) -> None:
        """What may be no such message. It waits for its place: on a busy machine Zenoh drops what
        follows on a long one otherwise."""
        self._sent += 1
        with_it = struct.pack("<qqB16s", self._sent, time.time_ns(), 16, b"r" * 16)
        block = zenoh.CongestionControl.BLOCK
        self.session.put(self.key(topic, kind), data, attachment=with_it, congestion_control=block)

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get("@ros2_lv/0/**")
        return sorted(str(one.ok.key_expr) for one in replies if one.ok)


def opened(mode: str, **where: str) -> Any:
    config = zenoh.Config()
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    for name, endpoint in where.items():
        config.insert_json5(f"{name}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


@contextmanager
def network(at: str) -> Iterator[Ros]:
    router = opened("router", listen=at)
    ros = Ros(at)
    yield ros
    ros.session.close()
    router.close()
