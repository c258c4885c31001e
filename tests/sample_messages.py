"""Messages with plain values, of which a test names those that it is about."""

from typing import Any

from bayesrace.messages import Event, Reply, Scalar, State, Status

__all__ = ["event", "reply", "state", "status"]


def state(seq: int = 0, **changes: Any) -> State:
    """A state of a free-running plant."""
    values: dict[str, Any] = {
        "source_time_ns": 0, "epoch": 1, "run": 1, "time_s": 0.0, "x": (0.0,) * 7,
        "u_applied": (0.0, 0.0), "lap": 0, "lockstep": False, "actuation_delays": (),
        "final": False,
    }  # fmt: skip
    return State(seq=seq, **(values | changes))


def status(**changes: Any) -> Status:
    """The status of a plant that waits for a run."""
    values: dict[str, Any] = {
        "seq": 0, "source_time_ns": 0, "source": "plant", "phase": "idle", "epoch": 0, "run": 0,
        "text": "", "weights_version": "", "track": "", "rate_hz": 0.0, "state_age_s": -1.0,
        "delay_s": 0.0, "counters": {},
    }  # fmt: skip
    return Status(**(values | changes))


def event(seq: int = 0, **changes: Any) -> Event:
    """An event of a plant."""
    values: dict[str, Any] = {
        "source_time_ns": 0, "run": 0, "source": "plant", "kind": "kind", "text": "text",
        "data": {},
    }  # fmt: skip
    return Event(seq=seq, **(values | changes))


def reply(accepted: bool, text: str = "", **data: Scalar) -> Reply:
    """The answer to a request."""
    return Reply(seq=0, source_time_ns=0, accepted=accepted, text=text, data=data)
