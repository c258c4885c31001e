"""The controller's side of the conversation with the validator process: see validator.py.

One message at a time: recorded states, what is in use once all states before its adoption have been
sent, and a file to check. A validator that has just started is sent everything anew.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from controller.weights.adoption import Adoption
from controller.weights.store import History
from controller.weights.supervisor import Supervisor

__all__ = ["ValidatorClient"]

_PING_S: Final = 1.0
"""From an answer of the validator to the next message at the latest."""
_CHUNK: Final = 64
"""States in a message: packing them takes 0.1 ms of the interpreter's lock."""


class ValidatorClient:
    """What the validator has been sent, and what it has answered; for one thread."""

    def __init__(
        self,
        supervisor: Supervisor,
        adoption: Adoption,
        history: History,
        rule: Callable[[str, str, Mapping[str, Any]], None],
    ) -> None:
        """``rule`` acts on what the watch finds about the weights in use: the fields of a
        :class:`.checks.Ruling`."""
        self._supervisor, self._adoption, self._history = supervisor, adoption, history
        self._rule = rule
        self._next, self._begin, self._stale = 0, 0, True
        """First state that has not been sent; first state with what is in use; whether the
        validator lacks that."""
        self._sent: Mapping[str, Any] = {}
        self._file: bytes | None = None
        self.verdict: Mapping[str, Any] = {}
        """On the file to check, by what is in use; empty before there is one."""

    def renew(self, begin: int) -> None:
        """Something else is in use, from the state with this number on."""
        self._begin, self._stale = begin, True

    def check(self, data: bytes | None) -> None:
        """Has a weights file checked; None: not any more."""
        if data is not None:
            self.verdict = {}
        self._file = data

    def follow(self) -> None:
        """Exchanges messages with the validator, which is started or replaced if need be."""
        supervisor = self._supervisor
        if (answer := supervisor.receive()) is not None:
            self._act_on(answer)
        self._adoption.validator = supervisor.ready
        if supervisor.idle and ((message := self._message()) or supervisor.age_s > _PING_S):
            self._sent = message
            supervisor.send(message)

    def _message(self) -> dict[str, Any]:
        """The next message to the validator; empty if there is nothing new."""
        message: dict[str, Any] = {}
        if states := self._adoption.states(self._next, _CHUNK):
            message["states"], self._next = states, states[-1].number + 1
        if self._stale and self._next >= self._begin:
            in_use, reference = self._history.in_use, self._history.reference
            message["context"] = {
                "in_use": in_use.data, "accepted_utc_ns": in_use.accepted_utc_ns,
                "reference": reference.data, "watched": not in_use.proven,
                "begin": self._begin, "slowed": self._adoption.slow is not None,
            }  # fmt: skip
            self._stale = False
        if self._file is not None and not self._stale and len(states) < _CHUNK:
            message["check"] = self._file
        return message

    def _act_on(self, answer: Mapping[str, Any]) -> None:
        """Acts on an answer, unless it is about weights that are not in use any more."""
        if not answer:  # the validator has just started
            self._next, self._stale, self._adoption.allowed = 0, True, -1
        elif not self._stale:
            for ruling in answer["watch"]:
                self._rule(*ruling)
            if all(action == "slow" for action, *_ in answer["watch"]):  # the watch goes on
                self._adoption.allowed = math.inf if answer["seen"] is None else answer["seen"]
        sent = self._sent.get("check")
        if sent is not None and sent is self._file and not self._stale:
            self._file, self.verdict = None, answer["verdict"]
