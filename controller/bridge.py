"""The bridge: joins Zenoh on behalf of a controller that speaks datagrams (docs/host.md).

States go to it as they come, by the transport's thread, and its answers go out as they are, by a
thread of their own; so the director, the recorder and learning see a controller as any other. The
main thread serves requests and publishes the heartbeat.
"""

import logging
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from bayesrace import clock
from bayesrace.controller.remote import RemoteDriver, RemoteLink
from bayesrace.controller.remote_weights import RemoteAdoption
from bayesrace.controller.service import Service
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import WeightsPort
from bayesrace.controller.weights.manager import WeightUpdateManager
from bayesrace.errors import InputError, RestartError
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    STATE,
    TELEMETRY,
    Decoder,
    Scalar,
    Seal,
    Updated,
    car_key,
)
from bayesrace.processes import die_with_parent
from bayesrace.realtime import SUSPENDED_S
from bayesrace.transport import HEARTBEAT_S, Endpoints, Inbox, Kind, Publisher, open_sessions
from bayesrace.transport.requests import in_transport_thread

__all__ = ["Bridge", "Updates", "main"]

_log = logging.getLogger("bayesrace.bridge")

_UNANSWERED_S: Final = 1.0
"""Without an answer for so long the controller is gone if no process listens any more. One that
hangs is gone as late as a link that is silent is closed: shorter stalls pass; ..."""
_UNANSWERED_LOCKSTEP_S: Final = 10.0
"""... in lockstep, which knows no limits of time, after so long."""
_SERVE_S: Final = 0.04
"""Between two requests while the car is driven, as in the process in Python."""
_UNREPORTED: Final = 100
"""So many actuations without telemetry: there will be none."""
_SWITCH_S: Final = 1e-4
"""A thread gets the interpreter's lock from another one this soon."""

_ANSWERS: Final = (ACTUATION, BRAKING, TELEMETRY)


@dataclass(frozen=True)
class Updates:
    """What new weights are taken by."""

    port: WeightsPort
    gate: GateSettings
    file_of: Callable[[bytes, str], bytes]
    """The controller's file of packed weights and their version."""


class Bridge:
    """Between an open session and a link."""

    def __init__(
        self, session: Any, name: str, endpoints: Endpoints, link: RemoteLink, track: str,
        rate_hz: float, updates: Updates | None = None,
    ) -> None:  # fmt: skip
        """``updates``: by what new weights are taken; without, none are."""
        self._link = link
        self.driver = RemoteDriver(link, track, None if updates is None else updates.port)
        self._publishers: dict[str, Publisher[Any]] = {
            one.name: Publisher(session, one, name) for one in _ANSWERS
        }
        self.inbox = Inbox(session, name)
        self._key, self._states = car_key(STATE.key, name), Decoder(STATE.message)
        self._refused = 0
        self._patience_s = max(endpoints.limits.lease_s, 3 / rate_hz)
        self._looked_s = clock.monotonic()
        self._closed = False
        self._failure: Exception | None = None
        """Of the thread that carries the answers."""
        self._publishing, self._holding = threading.Lock(), threading.Lock()
        self._service = Service(
            session, self.inbox, name, rate_hz, self.driver, self._counters,
            partial(self.inbox.presence, endpoints, "plant"),
        )  # fmt: skip
        self.inbox.watch("plant")
        self._adoption: RemoteAdoption | None = None
        self._weights: WeightUpdateManager | None = None
        if updates is not None:
            self._adoption = RemoteAdoption(link, updates.port, updates.gate, updates.file_of)
            self._service.weights = self._weights = WeightUpdateManager(
                session, name, updates.port, self._adoption, updates.gate, self._service.announce
            )
        self._listen(session)
        self._answers = threading.Thread(target=self._carry, name="answers", daemon=True)
        self._answers.start()
        if self._adoption is not None and self._weights is not None:
            try:
                self._adoption.begin()
            except InputError:
                self._end_answers()
                raise
            self._weights.start()
        self.inbox.announce("controller")  # last, when everything else is in place

    def _listen(self, session: Any) -> None:
        handler = in_transport_thread(self._forward)
        self._subscriber = session.declare_subscriber(self._key, handler)

    def _forward(self, sample: Any) -> None:
        """In the transport's thread."""
        payload = sample.payload.to_bytes()
        state = self._states(payload)
        if state is None:
            return
        before = self.driver.newest
        if self.driver.take(state):
            self._service.arrived_ns = clock.monotonic_ns()
            if before is None or (before.epoch, before.run) != (state.epoch, state.run):
                self._check_hold()  # a car that was stopped for want of its director may go now
        self.driver.forward(payload)

    def _check_hold(self) -> None:
        with self._holding:
            self._service.check_hold()

    def _carry(self) -> None:
        """Publishes the controller's answers until the bridge ends; in a thread of its own."""
        try:
            while not self._closed:
                if (data := self._link.receive(HEARTBEAT_S)) is not None:
                    self._publish(data)
        except Exception as error:
            self._failure = error

    def _end_answers(self) -> None:
        self._closed = True
        self._answers.join()

    def _publish(self, data: bytes) -> None:
        try:
            name, message = self.driver.note(data)
        except InputError:
            self._refused += 1
            return
        if isinstance(message, Updated) and self._adoption is not None:
            self._adoption.note(message)
        newest, publisher = self.driver.newest, self._publishers.get(name)
        if newest is not None and publisher is not None:
            with self._publishing:
                publisher.put(message, lockstep=newest.lockstep)

    def serve(self, renewed: Callable[[], Any] = lambda: None) -> None:
        """Until SIGINT or SIGTERM; ``renewed``: :meth:`.Sessions.renewed`, between runs.

        RestartError where the controller does not answer, InputError where it sends no telemetry.
        """
        try:
            while not self._service.stopping:
                self._service.beat()
                item = self.inbox.get(HEARTBEAT_S)
                if item is not None:
                    with self._holding:
                        self._service.react(item)
                    if item.kind is Kind.REQUEST and not self.driver.silent:
                        clock.sleep(_SERVE_S)
                self._service.report_fault()
                self._check_hold()
                with self._holding:
                    self.driver.repeat()
                self._check_controller()
                if self.driver.silent:
                    self._renew(renewed)
        finally:
            self._service.stopping = True
            if self._weights is not None:
                self._weights.stop()  # which may wait for an answer
            self._end_answers()

    def _check_controller(self) -> None:
        """The car must not seem to have a controller that it has not."""
        if self._failure is not None:
            raise self._failure
        if self._adoption is not None and self._adoption.restarted:
            raise RestartError(f"the controller at {self._link.name} has been started anew")
        looked_s, self._looked_s = self._looked_s, clock.monotonic()
        if self._looked_s - looked_s > SUSPENDED_S:
            self.driver.excuse()
        newest, unanswered_s = self.driver.newest, self.driver.unanswered_s
        lockstep = newest is not None and newest.lockstep
        patience_s = _UNANSWERED_LOCKSTEP_S if lockstep else self._patience_s
        if unanswered_s > _UNANSWERED_S:
            self._link.send(b"")  # refused if no process listens: a state may have come before
        if unanswered_s > (_UNANSWERED_S if self._link.refused else patience_s):
            raise RestartError(
                f"the controller at {self._link.name} does not answer: start it first, and the "
                "bridge again; both with the same --key, or none"
            )
        if self.driver.answers > _UNREPORTED and not self.driver.reports:
            raise InputError(f"the controller at {self._link.name} needs --telemetry")

    def _renew(self, renewed: Callable[[], Any]) -> None:
        with self._publishing:  # no answer is published while there is no session
            if (session := self._service.renew(renewed)) is None:
                return
            self._listen(session)
            for publisher in self._publishers.values():
                publisher.bind(session)
            if self._weights is not None:
                self._weights.bind(session)
            self.inbox.bind(session)  # last: it announces the process

    def _counters(self) -> dict[str, Scalar]:
        return {
            "ticks": self.driver.ticks,
            "states_received": self._states.accepted,
            "states_lost": self.driver.numbering.lost,
            "states_foreign": self.driver.foreign,
            "refused": self._states.refused + self._refused,
            **self._link.counters(),
            "requests_rejected": self.inbox.requests_rejected,
            "actuations_sent": self.driver.answers,
            "deadline_misses": self.driver.misses,
        }


def main(
    name: str, endpoints: Endpoints, link: str, track: str, rate_hz: float,
    updates: Updates | None = None, parent_pid: int | None = None, key: Path | None = None,
) -> int:  # fmt: skip
    """Bridge until SIGINT or SIGTERM; returns the exit code. Raises InputError at a bad start.

    ``link``: where the controller listens; ``track``: identity of the one that it drives;
    ``updates``: as of :class:`Bridge`; ``key``: file of the key that it has.
    """
    die_with_parent(parent_pid)
    endpoints.check_car(name)
    seal = None if key is None else Seal.read(key)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        remote = stack.enter_context(closing(RemoteLink(link, str(Path(folder) / "bridge"), seal)))
        sessions = stack.enter_context(open_sessions(endpoints, "controller"))
        sys.setswitchinterval(_SWITCH_S)
        bridge = Bridge(sessions.current, name, endpoints, remote, track, rate_hz, updates)
        _log.info("bridge of car '%s' to the controller at %s", name, link)
        with bridge.inbox.receive_signals():
            bridge.serve(sessions.renewed)
    return 0
