"""Which weights have been accepted, in which order, and the words for what has changed."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bayesrace.messages import Scalar
from bayesrace.transport import Request
from controller.gate.store import Accepted, digest_of, trimmed
from controller.takeover import Offer, WeightsPort

__all__ = ["Job", "Ledger"]

News = tuple[str, dict[str, Scalar]]
"""Text and data of an answer and an event."""


@dataclass
class Job:
    """A request, one's own question included, from its beginning to its answer."""

    kind: str
    data: bytes
    request: Request | None
    why: str = ""
    accepted_utc_ns: int | None = None
    """When another controller accepted them; None: nobody has."""
    answer_s: float = math.inf
    """By the monotonic clock, when whoever asks must have been answered; inf: nobody asks."""
    until_s: float = math.inf
    """How long what it waits for now may take: verdict, takeover, keeping."""
    facts: Mapping[str, Scalar] = field(default_factory=dict)
    """What the gate has compared."""
    offer: Offer | None = None
    over: bool = False
    """Refused, because the verdict takes too long; until that, the gatekeeper does nothing else."""
    answer: str = ""
    """Taken over; it is told as soon as the gatekeeper has kept it."""


class Ledger:
    """Keeps the port's history; for the courier's thread."""

    def __init__(self, port: WeightsPort) -> None:
        self._port = port
        self.counts = {"weights_taken": 0, "weights_refused": 0, "weights_rolled_back": 0}

    @property
    def newest(self) -> Accepted:
        """In use."""
        return self._port.history[-1]

    @property
    def before(self) -> Accepted | None:
        """Those before them."""
        return self._port.history[-2] if len(self._port.history) > 1 else None

    def offer(self, job: Job, facts: Mapping[str, Scalar], text: str, watch: bool) -> Offer | None:
        """What a job asks for, once the gate has passed it; None if there is nothing to go back to.

        ``watch``: whether new weights are watched.
        """
        if job.kind == "weights":
            version = str(facts["version"])
            return Offer(version, self._port.next_number, "weights", watch, text)
        before = self.before
        if before is None:
            return None
        return Offer(before.version, before.number, "previous", not before.proven)

    def offer_back(self, number: int, why: str) -> Offer:
        """Earlier weights, which the watch wants back."""
        old = next(one for one in self._port.history if one.number == number)
        return Offer(old.version, old.number, "give_up", watched=False, text=why)

    def accept(self, offer: Offer, job: Job, taken_us: float) -> News:
        """The offer, of this job's file, has been taken over."""
        port = self._port
        self.counts["weights_taken"] += 1
        at_ns = time.time_ns() if job.accepted_utc_ns is None else job.accepted_utc_ns
        accepted = Accepted(offer.number, offer.version, job.data, not offer.watched, at_ns)
        port.history = trimmed([*port.history, accepted])
        port.next_number = offer.number + 1
        who = f"weights {offer.version} {job.why}".rstrip()
        text = f"{who} in use from cycle {offer.cycle} on, as number {offer.number}; {offer.text}"
        mine: dict[str, Scalar] = {
            "number": offer.number, "cycle": offer.cycle, "takeover_us": taken_us
        }  # fmt: skip
        return text, {**job.facts, **mine}

    def go_back(self, offer: Offer, facts: Mapping[str, Scalar], request: str | None) -> News:
        """Earlier weights are in use again, on ``request`` (why) or because of the watch."""
        port, left = self._port, self._port.history[-1]
        self.counts["weights_rolled_back"] += 1
        while port.history[-1].number != offer.number:
            given_up = port.history.pop()
            if request is None:
                port.withdrawn.append(digest_of(given_up.data))
        what = offer.version or "no weights, as at the start"
        why = f"{left.version} {offer.text}" if request is None else f"on request: {request}"
        text = f"back to {what} (number {offer.number}) from cycle {offer.cycle} on; {why}"
        mine: dict[str, Scalar] = {
            "version": offer.version, "number": offer.number, "cycle": offer.cycle,
            "from_version": left.version, "from_number": left.number,
            "by": "watch" if request is None else "request",
        }  # fmt: skip
        return text, {**facts, **mine}

    def prove(self, number: int) -> News | None:
        """The watch over these is over; None if they are not in use any more."""
        newest = self.newest
        if newest.number != number:
            return None
        self._port.history[-1] = replace(newest, proven=True)
        text = f"weights {newest.version} (number {number}) have proved good"
        return text, {"version": newest.version, "number": number}
