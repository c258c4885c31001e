"""A link with delay, jitter, loss and partitions between two network interfaces, as a program.

    python emulator.py LEFT RIGHT [SEED]

forwards every Ethernet frame between the two interfaces, which must not do so themselves (two veth
ends in a network namespace of their own). It does what Linux's ``netem`` does, for kernels
without it. A line of JSON on stdin sets :class:`Conditions`, by direction: ``forth`` is from left
to right, ``back`` the other. It answers each line with the :class:`Counts` by direction. The end
of stdin ends the program, so it does not outlive its starter. It imports nothing of ours.
"""

import json
import os
import random
import select
import socket
import sys
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Final

__all__ = ["Conditions", "Counts", "Direction", "main"]

_EVERY_PROTOCOL: Final = 3  # ETH_P_ALL
_IGNORE_OUTGOING: Final = 23  # PACKET_IGNORE_OUTGOING, Linux 4.20
_LARGEST_FRAME: Final = 65536
_CAPACITY: Final = 10_000
_BUFFER: Final = 1 << 20


@dataclass(frozen=True)
class Conditions:
    """What a direction of the link does to each frame."""

    delay: float = 0.0
    """Mean time on the way [s]; a frame waits for the one before, as on a wire."""
    jitter: float = 0.0
    """The time is uniform in ``delay`` ± this [s]."""
    loss: float = 0.0
    """Probability that a frame is lost, each for itself."""
    cut: bool = False
    """No frame gets through."""


@dataclass
class Counts:
    """Frames of one direction so far."""

    forwarded: int = 0
    lost: int = 0
    """At random."""
    cut: int = 0
    """During a partition."""
    overflowed: int = 0


@dataclass
class Direction:
    """One way over the link; times are those of the monotonic clock [s]."""

    random: random.Random
    conditions: Conditions = field(default_factory=Conditions)
    counts: Counts = field(default_factory=Counts)
    _way: deque[tuple[float, bytes]] = field(default_factory=deque)
    _last_due: float = 0.0

    def enter(self, frame: bytes, now: float) -> None:
        """A frame sets off, or does not."""
        given = self.conditions
        if given.cut:
            self.counts.cut += 1
        elif self.random.random() < given.loss:
            self.counts.lost += 1
        elif len(self._way) >= _CAPACITY:
            self.counts.overflowed += 1
        else:
            due = now + max(given.delay + self.random.uniform(-given.jitter, given.jitter), 0.0)
            self._last_due = max(due, self._last_due)
            self._way.append((self._last_due, frame))

    @property
    def next_due(self) -> float:
        """When the next frame arrives; infinite without any on the way."""
        return self._way[0][0] if self._way else float("inf")

    def arrived(self, now: float) -> list[bytes]:
        """The frames whose time has come."""
        frames = []
        while self._way and self._way[0][0] <= now:
            frames.append(self._way.popleft()[1])
        self.counts.forwarded += len(frames)
        return frames


def _open(interface: str) -> socket.socket:
    # Protocol 0 until it is bound: else it would hear the other interfaces in between.
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    sock.setsockopt(263, _IGNORE_OUTGOING, 1)  # SOL_PACKET
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    sock.bind((interface, _EVERY_PROTOCOL))
    sock.setblocking(False)
    return sock


def _forward(direction: Direction, to: socket.socket) -> None:
    for frame in direction.arrived(time.monotonic()):
        try:
            to.send(frame)
        except OSError:  # its interface has no room or is down: a loss as any other
            direction.counts.overflowed += 1


def _take(direction: Direction, source: socket.socket) -> None:
    while True:
        try:
            frame = source.recv(_LARGEST_FRAME)
            # Read after the frame: a frame must not have set off before it was sent.
            direction.enter(frame, time.monotonic())
        except BlockingIOError:
            return
        except OSError:  # the interface went down
            return


def _obey(directions: dict[str, Direction], line: str) -> None:
    for name, given in json.loads(line).items():
        directions[name].conditions = Conditions(**given)
    answer = json.dumps({name: asdict(one.counts) for name, one in directions.items()})
    os.write(1, f"{answer}\n".encode())


def main(left: str, right: str, seed: int = 0) -> int:
    """Forwards until stdin ends."""
    names = ("forth", "back")
    directions = {name: Direction(random.Random(f"{seed} {name}")) for name in names}
    forth, back = directions.values()
    at_left, at_right = _open(left), _open(right)
    ways = ((forth, at_left, at_right), (back, at_right, at_left))
    _obey(directions, "{}")
    watched: list[socket.socket | int] = [at_left, at_right, 0]
    heard = b""
    while True:
        wait_s = max(min(forth.next_due, back.next_due) - time.monotonic(), 0.0)
        ready, _, _ = select.select(watched, [], [], min(wait_s, 3600.0))
        for direction, source, to in ways:
            if source in ready:
                _take(direction, source)
            _forward(direction, to)
        if 0 in ready:
            data = os.read(0, 4096)
            if not data:
                return 0
            *lines, heard = (heard + data).split(b"\n")
            for line in lines:
                _obey(directions, line.decode())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:4])))
