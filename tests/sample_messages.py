"""Messages with plain values, of which a test names those that it is about."""

from typing import Any

from bayesrace.messages import Event, Reply, Scalar, State, Status
from tests.driven import blank

__all__ = ["event", "reply", "state", "status"]


def state(seq: int = 0, **changes: Any) -> State:
    """A state of a free-running plant."""
    values = {"epoch": 1, "run": 1, "x": (0.0,) * 7, "u_applied": (0.0, 0.0)}
    return blank(State, seq=seq, **(values | changes))


def status(**changes: Any) -> Status:
    """The status of a plant that waits for a run."""
    values = {"source": "plant", "phase": "idle", "state_age_s": -1.0}
    return blank(Status, **(values | changes))


def event(seq: int = 0, **changes: Any) -> Event:
    """An event of a plant."""
    values = {"source": "plant", "kind": "kind", "text": "text"}
    return blank(Event, seq=seq, **(values | changes))


def reply(accepted: bool, text: str = "", **data: Scalar) -> Reply:
    """The answer to a request."""
    return blank(Reply, accepted=accepted, text=text, data=data)
