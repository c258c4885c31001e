"""A program that tries everything over one link, with a certificate or without, and tells what of
it got through. It has no access control of its own.

    python -m tests.security.intruder ENDPOINT [FOLDER]
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import zenoh

from bayesrace.messages import ALIVE, ALIVE_SOURCES, SERVICES, TOPICS
from tests.security.authority import CAR, OTHER

__all__ = [
    "ALIVE_KEYS", "FORGED", "KEYS", "SERVICE_KEYS", "TOPIC_KEYS", "bare_session", "listening",
    "settle",
]  # fmt: skip

_CARS: Final = (CAR, OTHER)
TOPIC_KEYS: Final = tuple(
    dict.fromkeys(
        topic.key.format(car=car, source=source)
        for car in _CARS for topic in TOPICS for source in topic.sources
    )
)  # fmt: skip
SERVICE_KEYS: Final = tuple(
    dict.fromkeys(
        one.key.format(car=car, source=source)
        for car in _CARS for one in SERVICES for source in one.servers
    )
)  # fmt: skip
ALIVE_KEYS: Final = tuple(
    ALIVE.format(car=car, source=source).replace("*", "1")
    for car in _CARS
    for source in ALIVE_SOURCES
)
KEYS: Final = (*TOPIC_KEYS, *SERVICE_KEYS, *ALIVE_KEYS, f"bayesrace/{CAR}/other", "elsewhere")

FORGED: Final = b"forged"
_SETTLE_S: Final = 0.4
_LINK_S: Final = 1.5


def settle() -> None:
    """Time for what was declared or sent to arrive."""
    time.sleep(_SETTLE_S)


def bare_session(endpoint: str, folder: Path | None, **settings: Any) -> Any:
    """A session of Zenoh's own, with a certificate but without our checks."""
    config = zenoh.Config()
    values: dict[str, Any] = {
        "mode": "peer", "connect/endpoints": [endpoint], "listen/endpoints": [],
        "connect/timeout_ms": -1, "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False, "scouting/gossip/enabled": False, **settings,
    }  # fmt: skip
    if folder is not None:
        certificate, key = str(folder / "certificate.pem"), str(folder / "key.pem")
        values["transport/link/tls"] = {
            "root_ca_certificate": str(folder / "ca.pem"), "enable_mtls": True,
            "connect_certificate": certificate, "connect_private_key": key,
        }  # fmt: skip
    for name, value in values.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def listening(where: str, folder: Path | None) -> Iterator[None]:
    """Something that listens with that certificate, whatever it is worth."""
    settings: dict[str, Any] = {"listen/endpoints": [where], "connect/endpoints": []}
    if folder is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(folder / "ca.pem"), "enable_mtls": True,
            "listen_certificate": str(folder / "certificate.pem"),
            "listen_private_key": str(folder / "key.pem"),
        }  # fmt: skip
    with bare_session(where, None, **settings):
        yield


def _try_everything(ears: Any, mouth: Any) -> dict[str, list[str]]:
    """Two links, so that nothing is answered by the program itself."""
    heard: set[str] = set()
    declared = [
        ears.declare_subscriber(key, lambda sample: heard.add(str(sample.key_expr)))
        for key in (*KEYS, "**", f"bayesrace/{CAR}/**")
    ]
    for key in KEYS:
        declared.append(
            ears.declare_queryable(key, lambda query: query.reply(query.key_expr, FORGED))
        )
        declared.append(ears.liveliness().declare_token(key))
    settle()
    print("ready", flush=True)  # noqa: T201
    sys.stdin.readline()
    for key in KEYS:
        mouth.put(key, FORGED, congestion_control=zenoh.CongestionControl.BLOCK)
        mouth.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
    named = zenoh.SourceInfo(mouth.id, 0)
    asked = [mouth.get(key, payload=FORGED, timeout=1.0, source_info=named) for key in KEYS]
    answers = [one.ok.key_expr for replies in asked for one in replies if one.ok is not None]
    present = [one.ok.key_expr for one in mouth.liveliness().get("bayesrace/**") if one.ok]
    for key in ALIVE_KEYS:
        present += [one.ok.key_expr for one in mouth.liveliness().get(key) if one.ok]
    settle()
    for one in declared:
        one.undeclare()
    return {
        "heard": sorted(heard), "answered": sorted(set(map(str, answers))),
        "present": sorted(set(map(str, present))),
    }  # fmt: skip


def main(endpoint: str, folder: str = "") -> None:
    """Tries, and prints what got through as JSON."""
    place = Path(folder) if folder else None
    with bare_session(endpoint, place) as ears:
        deadline = time.monotonic() + _LINK_S
        while not ears.info.links():
            if time.monotonic() >= deadline:
                print("no link", flush=True)  # noqa: T201
                return
            time.sleep(0.02)
        # A client sends what nobody has asked for.
        with bare_session(endpoint, place, mode="client") as mouth:
            print(json.dumps(_try_everything(ears, mouth)), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
