"""The validator process: decodes and judges weights, and watches those in use.

    python -m controller.weights.validator SOCKET ARTEFACT SETTINGS CAR

SOCKET is a file descriptor that it shares with the controller, SETTINGS and CAR are texts. A file
that crashes or blocks the process that decodes it affects this process alone. It keeps no state
that the next one needs: the first messages hold all recent states and say what is in use.
"""

import os
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import msgpack

from bayesrace.vehicles import CarParameters, described_car
from controller.weights.adoption import RECORDED
from controller.weights.checks import Checks, Ruling, Watch
from controller.weights.prediction import Sample, Sampler, StateRecord
from controller.weights.settings import GateSettings

__all__ = ["Validator"]

_NICE: Final = 5
"""Behind control, transport and plant, which share the CPUs."""

_Driven = tuple[StateRecord, Sample | None]
"""A state with the sample that it completes."""


class Validator:
    """Serves one controller until the connection is closed, with an EOFError.

    An empty message says that it has started. A message of the controller has any of ``states``,
    ``context`` (what is in use, once all states before its adoption have been sent) and ``check``
    (a weights file). The answer has ``seen``, the number of the next state, or None if nothing is
    watched; ``watch``, what the watch has found in these states: the fields of each
    :class:`.checks.Ruling`, in order; and the ``verdict`` on the file.
    """

    def __init__(self, connection: Connection, checks: Checks, car: CarParameters) -> None:
        self._connection, self._checks = connection, checks
        self._sampler = Sampler(checks.step_s, car)
        self._driven: deque[_Driven] = deque(maxlen=RECORDED)
        self._watch: Watch | None = None
        self._next = 0

    def serve(self) -> None:
        """Answers message after message."""
        answer: dict[str, Any] = {}
        while True:
            self._connection.send_bytes(msgpack.packb(answer))
            message = msgpack.unpackb(self._connection.recv_bytes(), use_list=False)
            answer = self._answer(message)

    def _answer(self, message: Mapping[str, Any]) -> dict[str, Any]:
        states = [StateRecord(*fields) for fields in message.get("states", ())]
        driven = [(state, self._sampler.add(state)) for state in states]
        self._driven += driven
        self._next = states[-1].number + 1 if states else self._next
        if "context" in message:
            driven = self._use(message["context"])
        rulings = self._follow(driven)
        answer: dict[str, Any] = {"seen": self._next if self._watch else None, "watch": rulings}
        if "check" in message:
            verdict = self._checks.judge(message["check"], self._recent(self._driven))
            answer["verdict"] = verdict._asdict()
        return answer

    def _use(self, context: Mapping[str, Any]) -> list[_Driven]:
        """Watches what is in use, if it is unproven; returns all states since its adoption."""
        self._checks.use(context["in_use"], context["accepted_utc_ns"], context["reference"])
        before = [one for one in self._driven if one[0].number < context["begin"]]
        watched = context["watched"]
        slowed = context["slowed"]
        self._watch = Watch(self._checks, self._recent(before), slowed) if watched else None
        return [one for one in self._driven if one[0].number >= context["begin"]]

    def _recent(self, driven: Iterable[_Driven]) -> list[Sample]:
        """Samples that are not too old to compare on."""
        oldest_ns = time.monotonic_ns() - round(self._checks.settings.recent_s * 1e9)
        return [sample for _, sample in driven if sample and sample.recorded_ns > oldest_ns]

    def _follow(self, driven: Iterable[_Driven]) -> list[Ruling]:
        """Continues the watch; what it finds depends on the states alone, not on when they come."""
        rulings: list[Ruling] = []
        for state, sample in driven:
            if (watch := self._watch) is None:
                break
            ruling = watch.add(state.fallen_back, sample)
            if ruling is not None:
                rulings.append(ruling)
            if ruling is not None and ruling.action == "back":
                self._watch = None
            elif watch.over:
                rulings.append(Ruling("proven", "", {}))
                self._watch = None
        return rulings


def main(arguments: list[str]) -> int:
    """The program; returns when the controller has ended."""
    os.nice(_NICE)
    socket, artefact, settings, text = arguments
    car = described_car(text)
    checks = Checks(GateSettings.model_validate_json(settings), Path(artefact), car)
    with suppress(EOFError, ConnectionError):
        Validator(Connection(int(socket)), checks, car).serve()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
