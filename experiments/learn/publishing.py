"""Handing weights to running controllers, and taking them back."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from bayesrace.errors import InputError
from bayesrace.gp.weights import MAX_BYTES
from bayesrace.messages import (
    ROLLBACK,
    WEIGHTS,
    Reply,
    RollbackRequest,
    Scalar,
    Service,
    car_key,
    decode,
    encode,
)

__all__ = ["Answer", "RefusalError", "read_bytes", "send_rollback", "send_weights"]


class RefusalError(RuntimeError):
    """The controller was asked and said no; the message is its reason."""


@dataclass(frozen=True)
class Answer:
    """What a controller said to new weights, or to going back."""

    accepted: bool
    text: str
    """Its words: what now, or why not."""
    version: str = ""
    """In use from now on, or refused."""
    before: str = ""
    """Of the weights given up, after going back."""
    cycle: int | None = None
    """Cycle of the controller from which on; None if it does not say."""
    acceptance: int | None = None
    """Number of this takeover among all of the car's."""

    @property
    def words(self) -> str:
        """For people."""
        if not self.accepted:
            return f"refused: {self.text}"
        if self.cycle is None:
            return f"taken over: {self.text}"
        which = "" if self.acceptance is None else f" (acceptance {self.acceptance})"
        return f"taken over at cycle {self.cycle}{which}"


def read_bytes(path: Path) -> bytes:
    """A weights file as it is: whether it is any good is the controller's to judge.

    InputError if it cannot be read, or is longer than any weights.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"cannot read weights file {path}: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise InputError(f"{path} is longer than any weights file; give one from 'bayesrace train'")
    return data


def send_weights(session: Any, car: str, data: bytes, timeout_s: float) -> Answer:
    """The controller's answer to these weights; InputError if none comes in time."""
    return _answer(_ask(session, WEIGHTS, car, data, timeout_s))


def send_rollback(session: Any, car: str, text: str, timeout_s: float) -> Answer:
    """Back to the weights before those in use; ``text``: why. InputError if no answer comes."""
    request = encode(RollbackRequest(0, time.monotonic_ns(), text[:2000]))
    return _answer(_ask(session, ROLLBACK, car, request, timeout_s))


def _ask(
    session: Any, service: Service[Any, Reply], car: str, payload: bytes, timeout_s: float
) -> Reply:
    """The answer; the refusal, if two controllers go by one name and one of them refuses."""
    key = car_key(service.key, car)
    replies = session.get(
        key,
        payload=payload,
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        # Two controllers under one name would otherwise be one answer.
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    answers = [decode(Reply, one.ok.payload.to_bytes()) for one in replies if one.ok is not None]
    if not answers:
        raise InputError(
            f"the controller of car '{car}' did not answer within {timeout_s:g} s; it has ended, "
            "hangs, or the network is slow: --timeout"
        )
    return next((one for one in answers if not one.accepted), answers[0])


def _answer(reply: Reply) -> Answer:
    return Answer(
        reply.accepted,
        reply.text,
        str(reply.data.get("version", "")),
        str(reply.data.get("from_version", "")),
        _count(reply.data.get("cycle")),
        _count(reply.data.get("number")),
    )


def _count(value: Scalar | None) -> int | None:
    return value if type(value) is int else None
