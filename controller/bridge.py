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
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from bayesrace import clock
from bayesrace.controller.remote import RemoteDriver, RemoteLink
from bayesrace.controller.service import Service
from bayesrace.errors import InputError, RestartError
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    STATE,
    TELEMETRY,
    Decoder,
    Scalar,
    car_key,
)
from bayesrace.processes import die_with_parent
from bayesrace.transport import HEARTBEAT_S, Endpoints, Inbox, Publisher, open_sessions
from bayesrace.transport.requests import in_transport_thread

__all__ = ["Bridge", "main"]

_log = logging.getLogger("bayesrace.bridge")

_UNANSWERED_S: Final = 1.0
"""Without an answer for so long, or for three periods, the controller is gone."""
_UNREPORTED: Final = 100
"""So many actuations without telemetry: there will be none."""
_SWITCH_S: Final = 1e-4
"""A thread gets the interpreter's lock from another one this soon."""

_ANSWERS: Final = (ACTUATION, BRAKING, TELEMETRY)


class Bridge:
    """Between an open session and a link."""

    def __init__(
        self, session: Any, name: str, endpoints: Endpoints, link: RemoteLink, track: str,
        rate_hz: float,
    ) -> None:  # fmt: skip
        self._link, self.driver = link, RemoteDriver(link, track)
        self._publishers: dict[str, Publisher[Any]] = {
            one.name: Publisher(session, one, name) for one in _ANSWERS
        }
        self.inbox = Inbox(session, name)
        self._key, self._states = car_key(STATE.key, name), Decoder(STATE.message)
        self._refused = 0
        self._patience_s = max(_UNANSWERED_S, 3 / rate_hz)
        self._failure: Exception | None = None
        """Of the thread that carries the answers."""
        self._publishing, self._holding = threading.Lock(), threading.Lock()
        self._service = Service(
            session, self.inbox, name, rate_hz, self.driver, self._counters,
            partial(self.inbox.presence, endpoints, "plant"),
        )  # fmt: skip
        self.inbox.watch("plant")
        self._listen(session)
        self._answers = threading.Thread(target=self._carry, name="answers", daemon=True)
        self._answers.start()
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
        before, self._service.arrived_ns = self.driver.newest, clock.monotonic_ns()
        self.driver.take(state)
        if before is None or (before.epoch, before.run) != (state.epoch, state.run):
            self._check_hold()  # a car that was stopped for want of its director may go now
        self.driver.forward(payload)

    def _check_hold(self) -> None:
        with self._holding:
            self._service.check_hold()

    def _carry(self) -> None:
        """Answers, until the process ends; in a thread of its own."""
        try:
            while not self._service.stopping:
                if (data := self._link.receive(HEARTBEAT_S)) is not None:
                    self._publish(data)
        except Exception as error:
            self._failure = error

    def _publish(self, data: bytes) -> None:
        try:
            name, message = self.driver.note(data)
        except InputError:
            self._refused += 1
            return
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
                    self._service.react(item)
                self._service.report_fault()
                self._check_hold()
                self.driver.repeat()
                self._check_controller()
                if self.driver.silent:
                    self._renew(renewed)
        finally:
            self._service.stopping = True
            self._answers.join()

    def _check_controller(self) -> None:
        """The car must not seem to have a controller that it has not."""
        if self._failure is not None:
            raise self._failure
        if self.driver.unanswered_s > self._patience_s:
            raise RestartError(
                f"the controller at {self._link.name} does not answer: start it first, and the "
                "bridge again"
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
            self.inbox.bind(session)  # last: it announces the process

    def _counters(self) -> dict[str, Scalar]:
        return {
            "ticks": self.driver.ticks,
            "states_received": self._states.accepted,
            "refused": self._states.refused + self._refused,
            "unsent": self._link.unsent,
            "requests_rejected": self.inbox.requests_rejected,
            "actuations_sent": self.driver.answers,
            "deadline_misses": self.driver.misses,
        }


def main(
    name: str, endpoints: Endpoints, link: str, track: str, rate_hz: float,
    parent_pid: int | None = None,
) -> int:  # fmt: skip
    """Bridge until SIGINT or SIGTERM; returns the exit code. Raises InputError at a bad start.

    ``link``: where the controller listens; ``track``: identity of the one that it drives.
    """
    die_with_parent(parent_pid)
    endpoints.check_car(name)
    with TemporaryDirectory() as folder, ExitStack() as stack:
        remote = stack.enter_context(closing(RemoteLink(link, str(Path(folder) / "bridge"))))
        sessions = stack.enter_context(open_sessions(endpoints, "controller"))
        sys.setswitchinterval(_SWITCH_S)
        bridge = Bridge(sessions.current, name, endpoints, remote, track, rate_hz)
        _log.info("bridge of car '%s' to the controller at %s", name, link)
        with bridge.inbox.receive_signals():
            bridge.serve(sessions.renewed)
    return 0
