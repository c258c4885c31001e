"""The controller's end of the gatekeeper: starting it, talking to it, ending it."""

import os
import signal
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayesrace.manifest import Manifest
from bayesrace.vehicles import CarParameters, car_text
from controller.gate.channel import Channel, Message
from controller.gate.launch import ended, spawn
from controller.gate.memory import Memory
from controller.gate.settings import GateSettings
from controller.gate.store import Accepted

__all__ = ["Link"]

_MODULE = "controller.gatekeeper"

_PATIENCE_S = 5.0
"""One that is stopped reads nothing, and a file may fill the connection."""


class Link:
    """One gatekeeper process, from its start to its end."""

    def __init__(self, memory: Memory) -> None:
        """Starts it; OSError if the system does not."""
        own, its = socket.socketpair()
        for fd in (its.fileno(), memory.fd):
            os.set_inheritable(fd, True)
        try:
            arguments = (its.fileno(), memory.fd, memory.capacity)
            self._pid = spawn(_MODULE, [str(number) for number in arguments])
        except BaseException:
            own.close()
            raise
        finally:
            its.close()
            os.set_inheritable(memory.fd, False)
        own.settimeout(_PATIENCE_S)
        self._channel = Channel(own)

    def fileno(self) -> int:
        """For ``poll``."""
        return self._channel.fileno()

    def begin(
        self,
        settings: GateSettings,
        artefact: Path,
        manifest: Manifest,
        car: CarParameters,
        history: Sequence[Accepted],
        next_number: int,
        withdrawn: Sequence[str],
        store: Path | None,
        watch_from: int,
    ) -> None:
        """Tells it where things stand; ends it if it cannot be told."""
        try:
            self.tell(
                "start",
                b"".join(one.data for one in history),
                settings=settings.model_dump(),
                artefact=str(artefact),
                car=car_text(car),
                discretisation=manifest.discretisation,
                history=[
                    (one.number, one.version, one.proven, one.accepted_utc_ns, len(one.data))
                    for one in history
                ],
                next_number=next_number,
                withdrawn=list(withdrawn),
                store=None if store is None else str(store.resolve()),
                watch_from=watch_from,
            )
        except BaseException:
            self.close()
            raise

    def tell(self, kind: str, payload: bytes = b"", **fields: Any) -> None:
        """If it is gone, or does not read, hearing tells."""
        if not self._channel.send(kind, payload, **fields):
            self._channel.shut()

    def hear(self) -> Message | None:
        """What it says; None if it is gone."""
        return self._channel.receive()

    def close(self) -> None:
        """Ends it, and waits for that a little."""
        self._channel.close()
        if not ended(self._pid, 1.0):
            os.kill(self._pid, signal.SIGKILL)
            ended(self._pid, 1.0)
