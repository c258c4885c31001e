"""The validator process: decodes and judges weights, and watches those in use.

    python -m controller.weights.validator SOCKET STATES

Both arguments are file descriptors that it shares with the controller. A weights file that crashes
or blocks the process that decodes it affects this process alone. It keeps no state that the next
one needs: recent states are in the shared memory, and the first message says what is in use.
"""

import os
import select
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import msgpack

from bayesrace.vehicles import described_car
from controller.weights.checks import Checks
from controller.weights.prediction import Sample, Sampler
from controller.weights.settings import GateSettings
from controller.weights.states import ALL, RING, SharedStates, StateRecord
from controller.weights.watch import Watch

__all__ = ["Validator"]

_NICE: Final = 5
"""Behind control, transport and plant, which share the CPUs."""
_LOCKSTEP_POLL_S: Final = 5e-5
"""The controller waits for the watch in lockstep."""
_POLL_S: Final = 0.02
_IDLE_NS: Final = 1_000_000_000
_BEATS: Final = 8
"""Heartbeats at least within ``hang_s``, after which the process would be replaced."""

_Driven = tuple[StateRecord, Sample | None]
"""A state with the sample that it completes."""


class Validator:
    """Serves one controller until the connection is closed, with an EOFError.

    Messages of the controller: ``context`` (what is in use) and ``check`` (a weights file).
    Answers: ``ready`` to the first context, ``verdict`` on each file, ``watch`` once a context.
    """

    def __init__(self, connection: Connection, states: SharedStates) -> None:
        self._connection, self._states = connection, states
        first = self._receive()
        settings = GateSettings.model_validate(first["settings"])
        car = described_car(first["car"])
        self._checks = Checks(settings, Path(first["artefact"]), car)
        self._sampler = Sampler(self._checks.step_s, car.tuning.gate.moving_mps)
        self._driven: deque[_Driven] = deque(maxlen=RING)
        self._next = 0
        self._use(first)
        self._states.beat()
        self._answer("ready")

    def serve(self) -> None:
        """Follows messages, and the watch between two of them."""
        while True:
            self._states.beat()
            self._judge(self._read() if self._watch else [])
            if select.select([self._connection], [], [], self._patience_s())[0]:
                message = self._receive()
                if message["kind"] == "context":
                    self._use(message)
                else:
                    self._check(message)

    def _receive(self) -> Mapping[str, Any]:
        message: Mapping[str, Any] = msgpack.unpackb(self._connection.recv_bytes())
        return message

    def _answer(self, kind: str, **fields: Any) -> None:
        self._connection.send_bytes(msgpack.packb({"kind": kind, **fields}))

    def _patience_s(self) -> float:
        """Longest wait for a message before the next look at states, or heartbeat."""
        if self._watch is None:
            return min(1.0, self._checks.settings.hang_s / _BEATS)
        newest = self._driven[-1][0] if self._driven else None
        idle = newest is None or time.monotonic_ns() - newest.recorded_ns > _IDLE_NS
        return _LOCKSTEP_POLL_S if newest and newest.lockstep and not idle else _POLL_S

    def _use(self, context: Mapping[str, Any]) -> None:
        """Watches what is in use, if it is unproven, over all states since its adoption."""
        self._checks.use(context["in_use"], context["accepted_utc_ns"], context["reference"])
        self._revision, begin = context["revision"], context["begin"]
        self._watch: Watch | None = None
        self._read()
        if not context["watched"]:
            self._states.report(self._revision, ALL)
            return
        before = [one for one in self._driven if one[0].number < begin]
        self._watch = Watch(self._checks, self._recent(before))
        self._judge([one for one in self._driven if one[0].number >= begin])

    def _check(self, message: Mapping[str, Any]) -> None:
        """Judges weights that were sent, after those in use by the newest states."""
        self._judge(self._read())
        verdict = self._checks.judge(message["data"], self._recent(self._driven))
        self._answer("verdict", check=message["check"], **verdict._asdict())

    def _read(self) -> list[_Driven]:
        """States that have been recorded meanwhile."""
        states, self._next = self._states.read(self._next)
        driven = [(state, self._sampler.add(state)) for state in states]
        self._driven += driven
        return driven

    def _recent(self, driven: Iterable[_Driven]) -> list[Sample]:
        """Samples that are not too old to compare on."""
        oldest_ns = time.monotonic_ns() - round(self._checks.settings.recent_s * 1e9)
        return [sample for _, sample in driven if sample and sample.recorded_ns > oldest_ns]

    def _judge(self, driven: Iterable[_Driven]) -> None:
        """Continues the watch; its result depends on the states alone, not on when it looks."""
        if (watch := self._watch) is None:
            return
        for state, sample in driven:
            reason = watch.add(state.fallen_back, sample)
            if reason is not None or watch.over:
                worse, data = (reason.text, reason.data) if reason else ("", {})
                self._watch = None
                self._states.report(self._revision, ALL, rolls_back=bool(worse))
                self._answer("watch", revision=self._revision, worse=worse, data=data)
                return
        self._states.report(self._revision, self._next)


def main(arguments: list[str]) -> int:
    """The program; returns when the controller has ended."""
    os.nice(_NICE)
    connection, states = map(int, arguments)
    with suppress(EOFError, ConnectionError):
        Validator(Connection(connection), SharedStates(states)).serve()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
