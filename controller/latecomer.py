"""A controller that joins late asks others of its car for the newest weights they have accepted.

Their answer, little-endian, is empty if there is nothing to tell:

    magic | u16 layout | u16 count | i64 accepted_utc_ns | count * sha256 | weights file or nothing

Newest is what was accepted last, by whoever accepted it first: going back to older weights makes
them no newer. What somebody has given up, because it predicted worse, is listed by its digest, and
taken from nobody.
"""

import logging
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from bayesrace.errors import InputError
from controller.gate.store import WITHDRAWN, Accepted, digest_of

__all__ = ["Found", "Latecomer", "Tell", "encode_answer", "newest_first"]

_log = logging.getLogger("bayesrace.controller")

_MAGIC: Final = b"BRACEAC\n"
_LAYOUT: Final = 1
_HEAD: Final = struct.Struct("<8sHHq")
_DIGEST_BYTES: Final = 32

_MOST_ANSWERS: Final = 32
"""That are read; a car has a controller or two."""

_CLOCKS_APART_NS: Final = 3600 * 10**9
"""By which another host's clock may be ahead: later weights would be the newest for ever."""

_MOST_TRIES: Final = 3
"""Of the same weights without a verdict: they may be what the gatekeeper dies of."""

_ASK_S: Final = (0.2, 1.0, 3.0)
"""When, after the start: connections take a moment, and then there is nobody."""


@dataclass(frozen=True)
class Found:
    """Weights that another controller has in use."""

    accepted_utc_ns: int
    data: bytes
    digest: str


def encode_answer(in_use: Accepted, withdrawn: Sequence[str]) -> bytes:
    """What a controller with these weights, which has given up those, answers."""
    given_up = [bytes.fromhex(digest) for digest in withdrawn[-WITHDRAWN:]]
    data = in_use.data if in_use.number else b""
    if not data and not given_up:
        return b""
    head = _HEAD.pack(_MAGIC, _LAYOUT, len(given_up), in_use.accepted_utc_ns)
    return head + b"".join(given_up) + data


def newest_first(
    answers: Sequence[bytes], most_bytes: int, now_utc_ns: int
) -> tuple[list[Found], list[str]]:
    """The weights in the answers that nobody has given up, each once; and why others are ignored.

    ``most_bytes``: of a weights file that can be of use. The order of the answers is no matter.
    """
    found: dict[str, Found] = {}
    given_up: set[str] = set()
    ignored = [f"more than {_MOST_ANSWERS} answers"] * max(len(answers) - _MOST_ANSWERS, 0)
    for answer in answers[:_MOST_ANSWERS]:
        try:
            one, digests = _decode(answer, most_bytes, now_utc_ns)
        except InputError as error:
            ignored.append(str(error))
            continue
        given_up.update(digests)
        if one is not None:
            found[one.digest] = min(found.get(one.digest, one), one, key=_age)
    left = [one for digest, one in found.items() if digest not in given_up]
    return sorted(left, key=_age, reverse=True), ignored


def _age(one: Found) -> tuple[int, str]:
    """To sort by; the digest for those of the same time."""
    return one.accepted_utc_ns, one.digest


def _decode(answer: bytes, most_bytes: int, now_utc_ns: int) -> tuple[Found | None, list[str]]:
    """Weights, if it has any, and digests of those given up; InputError if it is malformed."""
    if not answer:
        return None, []
    if len(answer) < _HEAD.size or not answer.startswith(_MAGIC):
        raise InputError(f"{len(answer)} bytes that are no answer of a controller of this release")
    _, layout, count, accepted_utc_ns = _HEAD.unpack_from(answer)
    if layout != _LAYOUT:
        raise InputError(f"layout {layout} is not {_LAYOUT}; use the same release everywhere")
    begin = _HEAD.size + count * _DIGEST_BYTES
    if count > WITHDRAWN or not begin <= len(answer) <= begin + most_bytes:
        raise InputError(f"{len(answer)} bytes are not the size of an answer with {count} digests")
    if not 0 <= accepted_utc_ns <= now_utc_ns + _CLOCKS_APART_NS:
        ahead_s = (accepted_utc_ns - now_utc_ns) * 1e-9
        raise InputError(f"weights accepted {ahead_s:.3g} s from now; set the clocks")
    digests = [
        answer[at : at + _DIGEST_BYTES].hex() for at in range(_HEAD.size, begin, _DIGEST_BYTES)
    ]
    data = answer[begin:]
    return Found(accepted_utc_ns, data, digest_of(data)) if data else None, digests


Tell = Callable[[Sequence[bytes]], None]
"""Takes the answers to a question."""


class Latecomer:
    """Asks a few times, as long as nobody decides what this controller is to drive with.

    What :meth:`next` brings is followed by :meth:`judged` or :meth:`put_back`.
    """

    def __init__(
        self,
        ask: Callable[[Tell], None],
        most_bytes: int,
        needed: bool,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``ask``: asks all others that are connected, and tells their answers once, now or later,
        in any thread. ``most_bytes``: see :func:`newest_first`. ``needed`` False: it has weights
        already, and is no latecomer."""
        self._ask, self._most_bytes, self._clock_s = ask, most_bytes, clock_s
        self._begin_s = clock_s()
        self._due_s = list(_ASK_S) if needed else []
        self._asked = False
        """The answers have not come yet."""
        self._answers: deque[Sequence[bytes]] = deque()
        self._found: list[Found] = []
        self._brought: Found | None = None
        self._judged: set[str] = set()
        self._tries: Counter[str] = Counter()
        self.ignored = 0
        """Answers that could not be used."""

    @property
    def asking(self) -> bool:
        """Whether there is a question left, or an answer that has not been looked at."""
        return bool(self._due_s or self._asked or self._found)

    def next(self, in_use: Accepted) -> Found | None:
        """The newest weights of others, newer than those in use, that were not judged yet."""
        if not self._asked and self._due_s and self._clock_s() - self._begin_s >= self._due_s[0]:
            self._due_s.pop(0)
            self._asked = True
            self._ask(self._answers.append)
        if self._asked and self._answers:
            self._asked = False
            self._read(self._answers.popleft())
        while self._found:
            one = self._found.pop(0)
            newer = not in_use.number or one.accepted_utc_ns > in_use.accepted_utc_ns
            if newer and one.digest not in self._judged:
                self._brought = one
                self._tries[one.digest] += 1
                return one
        return None

    def judged(self) -> None:
        """There is a verdict on what it has brought, which is not brought again."""
        if self._brought is not None:
            self._judged.add(self._brought.digest)
            self._brought = None

    def put_back(self) -> bool:
        """There is none, for another's fault: it stays the next. False if that was so too often."""
        one = self._brought
        if one is None or self._tries[one.digest] >= _MOST_TRIES:
            self.judged()
            return False
        self._brought = None
        self._found.insert(0, one)
        return True

    def stop(self) -> None:
        """It has been told what to drive with."""
        self._due_s.clear()
        self._found.clear()
        self._asked = False

    def _read(self, answers: Sequence[bytes]) -> None:
        self._found, ignored = newest_first(answers, self._most_bytes, time.time_ns())
        self.ignored += len(ignored)
        for why in ignored[:1]:
            _log.warning("ignored %d answer(s) of other controllers: %s", len(ignored), why)
