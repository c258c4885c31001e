"""Messages that no session of Zenoh carries, only links to a controller without Python: its new
weights.

They are carried in pieces and put together in the controller's buffer, from which they are staged,
then adopted between two cycles (controller/host/br_update.c). Each request has one answer; a
request with the ``seq`` of the one before gets the same answer again, so it can be repeated until
the answer has come.
"""

from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from bayesrace.messages.types import Count, Measure, Message, Number, Short, _one_of

__all__ = ["PIECE_BYTES", "RULING_ERRORS", "UPDATE", "UPDATED", "LinkTopic", "Update", "Updated"]

PIECE_BYTES: Final = 1024
"""Of the buffer, in one datagram, which no network then takes apart."""
RULING_ERRORS: Final = 9
"""One-step errors of the weights in use, the proven ones and none, three outputs each."""

_Piece = Annotated[bytes, Meta(max_length=PIECE_BYTES)]
_Small = Annotated[int, Meta(ge=0, le=2**31 - 1)]


class Update(Message, frozen=True, kw_only=True):
    """What the controller is to do about weights.

    write: put ``data`` into the buffer at ``at``; stage: load the file of ``at`` bytes in it;
    adopt: put what is staged into use; sample: fill the buffer with the newest ``Updated.size``
    samples of what the car did, as br_mpc_get_samples (controller/native/bayesrace_mpc.h) with room
    for all; read: the answer has the buffer's bytes from ``at`` on; look: nothing.
    """

    action: Annotated[str, _one_of(("write", "stage", "adopt", "sample", "read", "look"))]
    at: _Small
    reverted: Count
    """Of adopt and sample: they are refused if the watch has gone back more often."""
    watched: bool
    """Of adopt: on probation; else the weights count as proven."""
    data: _Piece


class Updated(Message, frozen=True, kw_only=True):
    """What has come of the :class:`Update` with this ``seq``, and what the watch has found."""

    error: Short
    """Why it could not be done; else empty."""
    busy: bool
    """It is being done: ask again."""
    cycle: Count
    """Number (``Telemetry.tick``) of the next cycle."""
    size: _Small
    """Of sample: how many there are."""
    data: _Piece
    version: Short
    """Of the weights in use."""
    adoption_us: Measure
    unknown_s: Number
    """Time per lap that the weights adopted last lose to the line as they do not know the car."""
    rulings: Count
    """So far."""
    reverted: Count
    """Of these, how many have gone back."""
    ruling: Annotated[int, Meta(ge=0, le=4)]
    """The newest, a br_mpc_ruling (controller/native/bayesrace_mpc.h), before the cycle
    ``ruled_at``; what follows is the br_mpc_trial that led to it."""
    ruled_at: Count
    samples: Count
    fresh: Measure
    cycles: Count
    fallen_back: Count
    fastest_mps: Measure
    limit_mps: Measure
    errors: Annotated[tuple[Measure, ...], Meta(min_length=RULING_ERRORS, max_length=RULING_ERRORS)]


@dataclass(frozen=True)
class LinkTopic:
    """A row of the table of messages that only such links carry."""

    name: str
    message: type[Message]


UPDATE: Final = LinkTopic("update", Update)
UPDATED: Final = LinkTopic("updated", Updated)
