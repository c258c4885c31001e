"""Which weights have been accepted, in which order, and the words for what has changed."""

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
    until_s: float = 0.0
    facts: Mapping[str, Scalar] = field(default_factory=dict)
    """What the gate has compared."""
    offer: Offer | None = None
    answer: str = ""
    """Taken over; it is told as soon as the gatekeeper has kept it."""


class Ledger:
    """Keeps the port's history; for the courier's thread."""

    def __init__(self, port: WeightsPort) -> None:
        self._port = port

    @property
    def newest(self) -> Accepted:
        """In use."""
        return self._port.history[-1]

    @property
    def before(self) -> Accepted | None:
        """Those before them."""
        return self._port.history[-2] if len(self._port.history) > 1 else None

    def named(self, number: int) -> Accepted:
        """The weights of this acceptance number."""
        return next(one for one in self._port.history if one.number == number)

    def accept(
        self,
        offer: Offer,
        data: bytes,
        facts: Mapping[str, Scalar],
        source: str,
        taken_us: float,
    ) -> News:
        """The offer, of this file, has been taken over."""
        port = self._port
        accepted = Accepted(offer.number, offer.version, data, proven=not offer.watched)
        port.history = trimmed([*port.history, accepted])
        port.next_number = offer.number + 1
        who = f"weights {offer.version} {source}".rstrip()
        text = f"{who} in use from cycle {offer.cycle} on, as number {offer.number}; {offer.text}"
        mine: dict[str, Scalar] = {
            "number": offer.number, "cycle": offer.cycle, "takeover_us": taken_us
        }  # fmt: skip
        return text, {**facts, **mine}

    def go_back(self, offer: Offer, facts: Mapping[str, Scalar], request: str | None) -> News:
        """Earlier weights are in use again, on ``request`` (why) or because of the watch."""
        port, left = self._port, self._port.history[-1]
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
