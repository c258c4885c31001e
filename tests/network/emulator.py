"""A link with delay, jitter, loss and partitions between two network interfaces, as a program.

    python emulator.py LEFT RIGHT [SEED]

forwards every Ethernet frame between the two interfaces, which must not do so themselves (two veth
ends in a network namespace of their own). It does what Linux's ``netem`` does, for kernels
without it. It takes commands as lines on stdin, and answers each with one line of JSON:

    set KEY VALUE ...    delay, jitter [s], loss [share of frames], reorder [0 or 1]
    cut / join           no frame gets through / they do again
    counts               only the answer

A line may end in ``forth`` (left to right) or ``back``; without, it is for both directions. The
end of stdin ends the program, so it does not outlive its starter. It imports nothing of ours.
"""

import heapq
import json
import os
import random
import select
import socket
import sys
import time
from dataclasses import asdict, dataclass, field, fields
from typing import Final

__all__ = ["Conditions", "Counts", "Direction", "Emulator", "main"]

_EVERY_PROTOCOL: Final = 3  # ETH_P_ALL
_IGNORE_OUTGOING: Final = 23  # PACKET_IGNORE_OUTGOING, Linux 4.20
_LARGEST_FRAME: Final = 65536
_CAPACITY: Final = 10_000
_BUFFER: Final = 1 << 20


@dataclass(frozen=True)
class Conditions:
    """What a direction of the link does to each frame."""

    delay: float = 0.0
    """Mean time on the way [s]."""
    jitter: float = 0.0
    """The time is uniform in ``delay`` ± this [s]."""
    loss: float = 0.0
    """Probability that a frame is lost, each for itself."""
    reorder: float = 0.0
    """0: a frame waits for the one before, as on a wire; else jitter changes the order."""


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
    is_cut: bool = False
    _way: list[tuple[float, int, bytes]] = field(default_factory=list)
    _last_due: float = 0.0
    _number: int = 0

    def enter(self, frame: bytes, now: float) -> None:
        """A frame sets off, or does not."""
        if self.is_cut:
            self.counts.cut += 1
        elif self.random.random() < self.conditions.loss:
            self.counts.lost += 1
        elif len(self._way) >= _CAPACITY:
            self.counts.overflowed += 1
        else:
            heapq.heappush(self._way, (self._due(now), self._number, frame))
            self._number += 1

    def _due(self, now: float) -> float:
        jitter = self.conditions.jitter
        due = now + max(self.conditions.delay + self.random.uniform(-jitter, jitter), 0.0)
        if not self.conditions.reorder:
            due = max(due, self._last_due)
            self._last_due = due
        return due

    @property
    def next_due(self) -> float:
        """When the next frame arrives; infinite without any on the way."""
        return self._way[0][0] if self._way else float("inf")

    def arrived(self, now: float) -> list[bytes]:
        """The frames whose time has come."""
        frames = []
        while self._way and self._way[0][0] <= now:
            frames.append(heapq.heappop(self._way)[2])
        self.counts.forwarded += len(frames)
        return frames


class Emulator:
    """Both directions, and the commands they take."""

    def __init__(self, seed: int = 0) -> None:
        self.directions = {
            name: Direction(random.Random(f"{seed} {name}")) for name in ("forth", "back")
        }

    def obey(self, line: str) -> str:
        """Executes one line; the answer, which has an ``error`` if there is one in the line."""
        words = line.split()
        chosen = list(self.directions.values())
        if words and words[-1] in self.directions:
            chosen = [self.directions[words.pop()]]
        try:
            self._execute(words, chosen)
        except (KeyError, ValueError, TypeError) as error:
            return json.dumps({"error": f"'{line.strip()}': {error!r}"})
        return json.dumps({name: asdict(one.counts) for name, one in self.directions.items()})

    @staticmethod
    def _execute(words: list[str], chosen: list[Direction]) -> None:
        match words:
            case ["set", *pairs]:
                known = {one.name for one in fields(Conditions)}
                given = dict(zip(pairs[::2], map(float, pairs[1::2]), strict=True))
                if unknown := given.keys() - known:
                    raise KeyError(*unknown)
                for direction in chosen:
                    direction.conditions = Conditions(**given)
            case ["cut" | "join" as word]:
                for direction in chosen:
                    direction.is_cut = word == "cut"
            case ["counts"]:
                pass
            case _:
                raise KeyError("set, cut, join or counts")


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


def _say(text: str) -> None:
    os.write(1, f"{text}\n".encode())


def main(left: str, right: str, seed: int = 0) -> int:
    """Forwards until stdin ends."""
    emulator = Emulator(seed)
    forth, back = emulator.directions.values()
    at_left, at_right = _open(left), _open(right)
    ways = ((forth, at_left, at_right), (back, at_right, at_left))
    _say(emulator.obey("counts"))
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
                _say(emulator.obey(line.decode()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:4])))
