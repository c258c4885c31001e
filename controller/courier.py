"""Carries weights between the network, the gatekeeper and the control loop, in a thread of its own.

The thread sleeps until something happens, and what takes long is done by others: the gatekeeper
decodes and checks, the compiled code copies, both without the interpreter's lock. So the control
thread, which shares that lock, is not held up.
"""

import contextlib
import logging
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import ACCEPTED, ROLLBACK, WEIGHTS, Reply, Scalar
from bayesrace.transport import Request, declare_service, decode_request
from controller.gate.link import Link
from controller.gate.memory import Memory
from controller.gate.settings import GateSettings
from controller.latecomer import Latecomer
from controller.ledger import Job, Ledger
from controller.takeover import Offer, Takeover, WeightsPort

__all__ = ["Courier"]

_log = logging.getLogger("bayesrace.controller")

_TAKE_S: Final = 5.0
"""The control loop, driving or idle, takes over within a cycle or a heartbeat; this is a stall."""

_OFFERED_MS: Final = 5
"""How often the thread looks whether an offer has been taken: the control thread wakes nobody."""
_HURRY_MS: Final = 200

_START_S: Final = 15.0
"""Until then a gatekeeper is there or something is wrong."""

_RESTART_S: Final = 1.0
_LONGEST_PAUSE_S: Final = 30.0
"""From an end to the next start, doubled for each that ends before it was ready: one that cannot
start must not keep a CPU busy beside the control loop."""

_MOST_REQUESTS: Final = 32
"""That wait; each may hold a file."""

_FILE_BYTES: Final = 100_000
"""Of a weights file, beyond its arrays."""

Announce = Callable[[str, str, Mapping[str, Scalar]], None]
"""Publishes an event: kind, text, data. Called from the courier's thread."""


class Courier:
    """Begins with :meth:`start`; ends with :meth:`stop`, the gatekeeper with it."""

    def __init__(
        self,
        session: Any,
        name: str,
        port: WeightsPort,
        settings: GateSettings,
        adopt: Callable[[str], None],
        announce: Announce,
    ) -> None:
        self._session, self._name, self._port, self._settings = session, name, port, settings
        self._announce = announce
        manifest = port.step.manifest
        self._memory = Memory(manifest.gp_capacity)
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        os.set_blocking(self._wake, False)
        self.takeover = Takeover(self._memory, adopt)
        self.takeover.watching = not port.history[-1].proven
        self.text = ""
        """What there is to say about weights; empty while all is well."""
        self.counters: dict[str, int] = {
            "weights_taken": 0, "weights_refused": 0, "weights_rolled_back": 0,
            "gatekeeper_starts": 0,
        }  # fmt: skip
        self._link: Link | None = None
        self._started_s = self._ended_s = 0.0
        self._pause_s = _RESTART_S
        self._requests: deque[Request] = deque()
        self._job: Job | None = None
        self._watched_from = 0
        self._ledger = Ledger(port)
        self._facts: Mapping[str, Scalar] = {}
        """Why the watch goes back."""
        self._offered = 0
        """Offers of which it is not known yet what has become."""
        fresh = len(port.history) == 1 and not port.history[0].data
        self._latecomer = Latecomer(session, name, fresh)
        self._stopping = False
        most = 3 * 8 * 7 * (manifest.gp_capacity + 1) + _FILE_BYTES
        self._most_bytes = most
        self._declared = [
            declare_service(session, service, name, self._arrive, most)
            for service in (WEIGHTS, ROLLBACK, ACCEPTED)
        ]
        self._thread = threading.Thread(target=self._run, name="courier")

    def status(self) -> dict[str, Scalar]:
        """What has happened, by name."""
        takeover = self.takeover
        return {
            **self.counters,
            "weights_number": self._ledger.newest.number,
            "weights_watched": not self._ledger.newest.proven,
            "gatekeeper": takeover.gatekeeper,
            "takeover_us": takeover.taken_us,
            "takeover_longest_us": takeover.longest_us,
            "watch_missed": takeover.unwatched,
        }

    def start(self) -> None:
        """Before the control thread gets its priority and its CPU, which are not for this one."""
        self._spawn()
        self._thread.start()

    def stop(self) -> None:
        """Refuses what is not answered, and ends thread and gatekeeper."""
        self._stopping = True
        self._rouse()
        self._thread.join()
        if self._link is not None:
            self._link.close()

    # The thread ----------------------------------------------------------------------------------

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        if len(self._requests) >= _MOST_REQUESTS:
            self._reply(request, False, f"{_MOST_REQUESTS} requests wait already: try later", {})
            return
        self._requests.append(request)
        self._rouse()

    def _rouse(self) -> None:
        with contextlib.suppress(BlockingIOError):  # full of wake-ups
            os.write(self._wake, b"\0")

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._turn()
            except Exception:
                # Without this thread nobody could send weights, and bad ones would not be given up.
                _log.exception("weights: a fault of the controller's own")
                self._bereaved()
        for request in [*self._requests, *([self._job.request] if self._job else [])]:
            if request is not None:
                self._reply(request, False, "the controller ends", {})

    def _turn(self) -> None:
        """Waits, and does what there is to do."""
        self._wait()
        while self.takeover.taken:
            self._taken(self.takeover.taken.popleft())
        self._expire()
        while self._requests and self._job is None and not self._stopping:
            if not self._begin(self._requests[0]):
                break
            self._requests.popleft()
        if self._latecomer.asking:
            self._ask_others()

    def _wait(self) -> None:
        """Until something has happened, or may have to be done; reads what the gatekeeper says."""
        poll = select.poll()
        poll.register(self._woken, select.POLLIN)
        if self._link is not None:
            poll.register(self._link.fileno(), select.POLLIN)
        idle = self._job is None and self._link is not None and not self._latecomer.asking
        hurry = not idle or not self.takeover.gatekeeper
        patience_ms = _OFFERED_MS if self._offered else _HURRY_MS if hurry else None
        for fd, _ in poll.poll(patience_ms):
            if fd == self._woken:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            elif self._link is not None:
                self._hear()

    def _expire(self) -> None:
        now_s, job = time.monotonic(), self._job
        if self._link is None:
            # What is offered has to be settled first: the next one is told where things stand.
            if not self._offered and now_s - self._ended_s > self._pause_s:
                self._spawn()
        elif not self.takeover.gatekeeper and now_s - self._started_s > _START_S:
            self._bereaved()
        if job is None or now_s < job.until_s:
            return
        if job.answer:
            self._settled()
            return
        if job.offer is None:  # it hangs: what it would say later is for a request long answered
            self._bereaved()
            return
        with contextlib.suppress(ValueError):  # taken at this moment: then it counts
            self.takeover.offers.remove(job.offer)
            self._offered -= 1
            self._tell("dropped")
            self._refuse(f"the control loop did not take over within {_TAKE_S:g} s", {})

    # The gatekeeper ------------------------------------------------------------------------------

    def _spawn(self) -> None:
        """Starts the gatekeeper and tells it where things stand."""
        self._started_s = time.monotonic()
        try:
            self._link = Link(self._memory)
        except (InputError, OSError) as error:
            self._pause()
            self._say("gatekeeper_ended", f"the gatekeeper cannot be started: {error}")
            return
        self.counters["gatekeeper_starts"] += 1
        port = self._port
        self._link.begin(
            self._settings, port.artefact, port.step.manifest, port.history, port.next_number,
            port.withdrawn, port.store, self._watched_from,
        )  # fmt: skip

    def _tell(self, kind: str, payload: bytes = b"", **fields: Any) -> None:
        if self._link is not None:
            self._link.tell(kind, payload, **fields)

    def _hear(self) -> None:
        heard = None if self._link is None else self._link.hear()
        if heard is None:
            self._bereaved()
            return
        fields = heard[0]
        match fields["kind"]:
            case "ready":
                self.takeover.gatekeeper = True
                self._pause_s = _RESTART_S
                self.text = ""
            case "refused":
                self._refuse(fields["text"], fields["data"])
            case "offer":
                self._offer(fields)
            case "give_up":
                self._give_up(fields)
            case "settled":
                self._settled()
            case "proven":
                if news := self._ledger.prove(int(fields["number"])):
                    self._announce("weights_proven", *news)
            case "complaint":
                self._say("weights_not_kept", fields["text"])

    def _bereaved(self) -> None:
        """The gatekeeper is gone; the car is driven on with what is in use."""
        if not self.takeover.gatekeeper:
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._pause()
        self.takeover.gatekeeper = False
        if self._link is not None:
            self._link.close()
            self._link = None
        self._say(
            "gatekeeper_ended",
            "the gatekeeper ended or hung (killed, or by a fault): weights in use stay and are not "
            "watched until it is there again",
        )
        if self._job is not None and self._job.answer:
            self._settled()
        elif self._job is not None and self._job.offer is None:
            self._refuse(f"{self.text}; send them again in a moment", {})

    def _pause(self) -> None:
        self._ended_s = time.monotonic()

    def _say(self, kind: str, text: str) -> None:
        self.text = text
        _log.warning("%s", text)
        self._announce(kind, text, {})

    # Requests ------------------------------------------------------------------------------------

    def _begin(self, request: Request) -> bool:
        """Starts on a request; False if it has to wait for the gatekeeper, which is starting."""
        if request.service is ACCEPTED:
            newest = self._ledger.newest
            request.answer_raw(newest.data if newest.number else b"")
            return True
        if not self.takeover.gatekeeper:
            if time.monotonic() - self._started_s < _START_S and not self.text:
                return False
            text = self.text or f"the gatekeeper has not started within {_START_S:g} s"
            self._refused(request, f"{text}; send them again in a moment", {})
            return True
        if request.service is ROLLBACK:
            self._begin_rollback(request)
        elif request.size > self._most_bytes:
            self._refused(
                request, f"{request.size} bytes are more than any weights that would fit", {}
            )
        else:
            self._begin_check(request.payload, request)
        return True

    def _begin_check(self, data: bytes, request: Request | None, why: str = "") -> None:
        self._job = Job("weights", data, request, why, time.monotonic() + _START_S)
        self._tell("check", data, number=self._port.next_number)

    def _begin_rollback(self, request: Request) -> None:
        message, why_not = decode_request(request)
        if message is not None and self._ledger.before is None:
            why_not = "there are no weights before those in use"
        if why_not:
            self._reply(request, False, why_not, {})
            return
        until_s = time.monotonic() + _START_S
        self._job = Job("previous", b"", request, message.text, until_s)
        self._tell("previous", number=self._ledger.newest.number)

    def _ask_others(self) -> None:
        if self._ledger.before is not None:
            self._latecomer.stop()
        elif self._job is None and self.takeover.gatekeeper and (data := self._latecomer.ask()):
            self._begin_check(data, None, "from another controller of this car")

    def _refuse(self, text: str, data: Mapping[str, Scalar]) -> None:
        job, self._job = self._job, None
        if job is None:
            return
        if job.kind == "previous":
            if job.request is not None:
                self._reply(job.request, False, text, data)
            return
        self._refused(job.request, text, data)

    def _refused(self, request: Request | None, text: str, data: Mapping[str, Scalar]) -> None:
        self.counters["weights_refused"] += 1
        if request is not None:
            self._reply(request, False, text, data)
        self._announce("weights_refused", text, data)

    @staticmethod
    def _reply(request: Request, accepted: bool, text: str, data: Mapping[str, Scalar]) -> None:
        request.answer(Reply(0, time.monotonic_ns(), accepted, text[:2000], dict(data)))

    # Takeover ------------------------------------------------------------------------------------

    def _stage(self, offer: Offer) -> str:
        """Lays the weights in shared memory beside those in use, and offers them; "" or why not."""
        try:
            self._port.step.stage_weights(self._memory.outputs())
        except InputError as error:
            self._tell("dropped")
            return str(error)
        self._offered += 1
        self.takeover.offers.append(offer)
        return ""

    def _offer(self, fields: Mapping[str, Any]) -> None:
        job, before = self._job, self._ledger.before
        if job is None:  # has been refused meanwhile: it took too long
            self._tell("dropped")
            return
        if job.kind == "previous":
            if before is None:
                self._tell("dropped")
                self._refuse("there are no weights before those in use any more", {})
                return
            offer = Offer(before.version, before.number, "previous", not before.proven)
        else:
            version, watched = str(fields["data"]["version"]), self._settings.watch_s > 0
            number = self._port.next_number
            offer = Offer(version, number, "weights", watched, fields["text"])
        job.facts, job.offer = fields["data"], offer
        job.until_s = time.monotonic() + _TAKE_S
        why_not = self._stage(offer)
        if why_not:
            self._refuse(why_not, {})

    def _give_up(self, fields: Mapping[str, Any]) -> None:
        old = self._ledger.named(int(fields["number"]))
        offer = Offer(old.version, old.number, "give_up", watched=False, text=fields["text"])
        self._facts = fields["data"]
        why_not = self._stage(offer)
        if why_not:
            self._say("weights_refused", f"going back is not possible: {why_not}")

    def _taken(self, offer: Offer) -> None:
        """The control thread has taken over: the gatekeeper is told, and whoever waits."""
        job = self._job
        self._offered -= 1
        if offer.cycle < 0:
            self._tell("dropped")
            if offer.kind == "give_up":
                self._say("weights_refused", f"going back was not possible: {offer.text}")
            else:
                self._refuse(offer.text, {})
            return
        self._watched_from = offer.noted
        if offer.kind == "give_up":
            self.counters["weights_rolled_back"] += 1
            self._announce("weights_rolled_back", *self._ledger.go_back(offer, self._facts, None))
        elif job is not None and offer.kind == "previous":
            self.counters["weights_rolled_back"] += 1
            job.answer, job.facts = self._ledger.go_back(offer, {}, job.why)
        elif job is not None:
            self.counters["weights_taken"] += 1
            taken_us = self.takeover.taken_us
            news = self._ledger.accept(offer, job.data, job.facts, job.why, taken_us)
            job.answer, job.facts = news
        self._tell("taken", noted=offer.noted)
        if self._link is None:
            self._settled()

    def _settled(self) -> None:
        """Answers who waits: what was taken over is kept, or nobody is there to keep it."""
        job = self._job
        if job is None or not job.answer:
            return
        self._job = None
        if job.request is not None:
            self._reply(job.request, True, job.answer, job.facts)
        event = "weights_accepted" if job.kind == "weights" else "weights_rolled_back"
        self._announce(event, job.answer, job.facts)
