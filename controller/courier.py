"""Carries weights between the network, the gatekeeper and the control loop, in a thread of its own.

The thread sleeps until something happens, and what takes long is done by others: the gatekeeper
decodes and checks, the compiled code copies, both without the interpreter's lock. So the control
thread, which shares that lock, is not held up.
"""

import logging
import select
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from bayesrace.messages import ACCEPTED, ROLLBACK, WEIGHTS, Scalar
from bayesrace.transport import Request, decode_request, fetch_all
from controller.gate.link import Link
from controller.gate.memory import Memory
from controller.gate.settings import GateSettings
from controller.gate.supervisor import Supervisor
from controller.latecomer import Latecomer, encode_answer
from controller.ledger import Job, Ledger
from controller.offers import Offers
from controller.questions import Questions
from controller.requests import ENDS, NOT_NOW, RequestQueue, reply
from controller.takeover import Offer, Takeover, WeightsPort

__all__ = ["Courier"]

_log = logging.getLogger("bayesrace.controller")

_TAKE_S: Final = 5.0
"""The control loop, driving or idle, takes over within a cycle or a heartbeat; this is a stall."""

_KEEP_S: Final = 5.0
"""Within which what has been taken over is kept, by the next gatekeeper if need be."""

_OFFERED_MS: Final = 5
"""How often the thread looks whether an offer has been taken: the control thread wakes nobody."""
_HURRY_MS: Final = 200

_NOT_KEPT: Final = "not_kept"
"""In the data of an answer: why a controller started again would not have these weights."""

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
        self._port, self._settings, self._publish = port, settings, announce
        capacity = port.step.manifest.gp_capacity
        memory = self._memory = Memory(capacity)
        self.takeover = Takeover(memory, adopt)
        self.takeover.watching = not port.history[-1].proven
        self._keeper = Supervisor(self._start_gatekeeper, lambda: memory.alive_s, settings.hang_s)
        self._trouble = ""
        """With weights, apart from a gatekeeper that is gone; until the next are kept."""
        self._job: Job | None = None
        self._watched_from = 0
        self._ledger = Ledger(port)
        self._facts: Mapping[str, Scalar] = {}
        """Why the watch goes back."""
        self._offers = Offers(port, memory, self.takeover)
        self._stopping = False
        self._most_bytes = 3 * 8 * 7 * (capacity + 1) + _FILE_BYTES
        fresh = len(port.history) == 1 and not port.history[0].data
        services = (WEIGHTS, ROLLBACK, ACCEPTED)
        self._requests = RequestQueue(session, name, services, self._most_bytes)
        self._questions = Questions(lambda: fetch_all(session, ACCEPTED, name), self._requests.wake)
        self._latecomer = Latecomer(self._questions.ask, self._most_bytes, fresh)
        self._thread = threading.Thread(target=self._run, name="courier")

    @property
    def text(self) -> str:
        """What there is to say about weights; empty while all is well."""
        return "; ".join(filter(None, (self._keeper.text, self._trouble)))

    def status(self) -> dict[str, Scalar]:
        """What has happened, by name."""
        takeover = self.takeover
        return {
            **self._ledger.counts,
            "weights_number": self._ledger.newest.number,
            "weights_watched": not self._ledger.newest.proven,
            "answers_ignored": self._latecomer.ignored,
            "gatekeeper": takeover.gatekeeper,
            "gatekeeper_starts": self._keeper.starts,
            "takeover_us": takeover.taken_us,
            "takeover_longest_us": takeover.longest_us,
            "watch_missed": takeover.unwatched,
        }

    def start(self) -> None:
        """Before the control thread gets its priority and its CPU, which are not for this one."""
        self._look_after_gatekeeper()
        self._thread.start()

    def stop(self) -> None:
        """Refuses what is not answered, and ends threads and gatekeeper."""
        self._stopping = True
        self._requests.wake()
        self._thread.join()
        self._keeper.close()
        self._questions.close()
        self._memory.close()

    # The thread ----------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._turn()
            except Exception:
                # Without this thread nobody could send weights, and bad ones would not be given up.
                _log.exception("weights: a fault of the controller's own")
                self._recover()
        try:
            self._settled(ENDS)
            self._refuse(ENDS, NOT_NOW)
        finally:
            self._requests.close()

    def _recover(self) -> None:
        try:
            self._keeper.lose("was ended after a fault of the controller's own")
            self._bereaved()
        except Exception:
            _log.exception("weights: another fault after that")

    def _announce(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        """Whoever waits for an answer does not depend on it."""
        try:
            self._publish(kind, text, data)
        except Exception:
            _log.exception("weights: the event %s cannot be published", kind)

    def _turn(self) -> None:
        """Waits, and does what there is to do."""
        self._wait()
        while (offer := self._offers.taken()) is not None:
            self._taken(offer)
        self._look_after_gatekeeper()
        self._expire()
        self._serve()
        if self._latecomer.asking:
            self._ask_others()

    def _wait(self) -> None:
        """Until something has happened, or may have to be done; reads what the gatekeeper says."""
        poll = select.poll()
        poll.register(self._requests, select.POLLIN)
        if (gatekeeper := self._keeper.fileno()) is not None:
            poll.register(gatekeeper, select.POLLIN)
        patience_ms = self._keeper.patience_s * 1e3
        if self._job is not None or self._requests or self._latecomer.asking:
            patience_ms = min(patience_ms, _HURRY_MS)
        for fd, _ in poll.poll(_OFFERED_MS if self._offers.under_way else patience_ms):
            if fd == self._requests.fileno():
                self._requests.hear()
            else:
                self._hear()

    def _expire(self) -> None:
        """Answers for what the control loop, or the gatekeeper, has not done in time."""
        job = self._job
        if job is None or job.over or time.monotonic() < job.until_s:
            return
        if job.answer:
            self._settled("the gatekeeper did not do so in time")
        elif job.offer is None:
            self._refused(job.request, "the gatekeeper has not answered in time", NOT_NOW)
            job.over = True
        elif self._offers.withdraw(job.offer):
            self._keeper.tell("dropped")
            self._refuse(f"the control loop did not take over within {_TAKE_S:g} s", NOT_NOW)

    # The gatekeeper ------------------------------------------------------------------------------

    def _start_gatekeeper(self) -> Link:
        """Starts one and tells it where things stand; OSError if the system does not."""
        link, port = Link(self._memory), self._port
        link.begin(
            self._settings, port.artefact, port.step.manifest, port.car, port.history,
            port.next_number, port.withdrawn, port.store, self._watched_from,
        )  # fmt: skip
        return link

    def _look_after_gatekeeper(self) -> None:
        # What is offered has to be settled first: the next one is told where things stand.
        if not self._keeper.look(may_start=not self._offers.under_way):
            self._bereaved()

    def _hear(self) -> None:
        heard = self._keeper.hear()
        if heard is None:
            self._bereaved()
            return
        fields = heard[0]
        match fields["kind"]:
            case "ready":
                self.takeover.gatekeeper = True
            case "refused":
                self._refuse(fields["text"], fields["data"])
            case "offer":
                self._offer(fields)
            case "give_up":
                self._give_up(fields)
            case "settled":
                self._kept(fields["why_not"])
            case "proven":
                if news := self._ledger.prove(int(fields["number"])):
                    self._announce("weights_proven", *news)

    def _bereaved(self) -> None:
        """The gatekeeper is gone; the car is driven on with what is in use."""
        self.takeover.gatekeeper = False
        text = self._keeper.text
        _log.warning("%s", text)
        self._announce("gatekeeper_ended", text, {})
        if self._job is not None and self._job.offer is None:
            self._refuse(f"{text}; send them again in a moment", NOT_NOW)
        self._settle_unkept()

    def _settle_unkept(self) -> None:
        """Without a store nobody has to be waited for; else the next gatekeeper keeps it first."""
        if self._port.store is None and not self.takeover.gatekeeper:
            self._settled()

    # Requests ------------------------------------------------------------------------------------

    def _serve(self) -> None:
        """Starts on what waits, one at a time; what has waited too long is turned away."""
        while (waiting := self._requests.pop()) is not None:
            request, answer_s = waiting
            if request.service is ACCEPTED:
                request.answer_raw(encode_answer(self._ledger.newest, self._port.withdrawn))
            elif time.monotonic() >= answer_s - _KEEP_S:
                why_not = "others, or the gatekeeper's start, have taken too long"
                self._refused(request, why_not, NOT_NOW)
            elif self._job is not None or not self._begin(request, answer_s):
                self._requests.put_back(waiting)
                return

    def _begin(self, request: Request, answer_s: float) -> bool:
        """Starts on a request; False if it has to wait for the gatekeeper, which is starting."""
        if not self.takeover.gatekeeper:
            if not self._keeper.text:
                return False
            why_not = f"{self._keeper.text}; send them again in a moment"
            self._refused(request, why_not, NOT_NOW)
            return True
        if request.service is ROLLBACK:
            self._begin_rollback(request, answer_s)
        elif request.size > self._most_bytes:
            self._refused(
                request, f"{request.size} bytes are more than any weights that would fit", {}
            )
        else:
            self._begin_check(Job("weights", request.payload, request, answer_s=answer_s))
        return True

    def _begin_check(self, job: Job) -> None:
        self._start(job)
        self._keeper.tell("check", job.data, number=self._port.next_number)

    def _begin_rollback(self, request: Request, answer_s: float) -> None:
        message, why_not = decode_request(request)
        if message is not None and self._ledger.before is None:
            why_not = "there are no weights before those in use"
        if why_not:
            reply(request, False, why_not, {})
            return
        self._start(Job("previous", b"", request, message.text, answer_s=answer_s))
        self._keeper.tell("previous", number=self._ledger.newest.number)

    def _start(self, job: Job) -> None:
        """The gatekeeper is asked next; what it takes too long for is answered without it."""
        self._job, job.until_s = job, job.answer_s - _KEEP_S

    def _ask_others(self) -> None:
        if self._job is not None or not self.takeover.gatekeeper:
            return
        found = self._latecomer.next(self._ledger.newest)
        if found is not None:
            why = "from another controller of this car"
            self._begin_check(Job("weights", found.data, None, why, found.accepted_utc_ns))

    def _refuse(self, text: str, data: Mapping[str, Scalar]) -> None:
        """Ends the job under way; ``data`` NOT_NOW: without a verdict."""
        job, self._job = self._job, None
        if job is None or job.over:
            return
        if job.request is None and data is NOT_NOW and self._latecomer.put_back():
            return
        self._latecomer.judged()
        self._refused(job.request, text, data)

    def _refused(self, request: Request | None, text: str, data: Mapping[str, Scalar]) -> None:
        if request is not None and request.service is ROLLBACK:
            reply(request, False, text, data)
            return
        self._ledger.counts["weights_refused"] += 1
        if request is not None:
            reply(request, False, text, data)
        self._announce("weights_refused", text, data)

    # Takeover ------------------------------------------------------------------------------------

    def _offer(self, fields: Mapping[str, Any]) -> None:
        """What the request under way asks for has passed the gate."""
        job, facts = self._job, fields["data"]
        watch = self._settings.watch_s > 0
        offer = None
        if job is not None and not job.over:
            offer = self._ledger.offer(job, facts, fields["text"], watch)
        if job is None or offer is None:
            self._keeper.tell("dropped")
            self._refuse("there are no weights before those in use any more", {})
            return
        job.facts, job.offer = facts, offer
        job.until_s = min(time.monotonic() + _TAKE_S, job.answer_s - _KEEP_S)
        if why_not := self._offers.put(offer):
            self._keeper.tell("dropped")
            self._refuse(why_not, {})

    def _give_up(self, fields: Mapping[str, Any]) -> None:
        """The watch wants to go back, whatever is under way."""
        self._facts = fields["data"]
        if why_not := self._offers.put(self._ledger.offer_back(fields["number"], fields["text"])):
            self._keeper.tell("dropped")
            self._complain("weights_refused", f"going back is not possible: {why_not}")

    def _taken(self, offer: Offer) -> None:
        """The control thread has taken over: the gatekeeper is told, and whoever waits."""
        job = self._job
        if offer.cycle < 0:
            self._keeper.tell("dropped")
            if offer.kind == "give_up":
                self._complain("weights_refused", f"going back was not possible: {offer.text}")
            else:
                self._refuse(offer.text, {})
            return
        self._watched_from = offer.noted
        if offer.kind == "give_up":
            self._announce("weights_rolled_back", *self._ledger.go_back(offer, self._facts, None))
        elif job is not None:
            self._answer_taken(offer, job)
        self._keeper.tell(
            "taken", noted=offer.noted, accepted_utc_ns=self._ledger.newest.accepted_utc_ns
        )
        self._settle_unkept()

    def _answer_taken(self, offer: Offer, job: Job) -> None:
        """Makes the answer, for when it is kept."""
        if offer.kind == "previous":
            job.answer, job.facts = self._ledger.go_back(offer, {}, job.why)
        else:
            job.answer, job.facts = self._ledger.accept(offer, job, self.takeover.taken_us)
        if job.request is None:
            self._latecomer.judged()
            job.until_s = time.monotonic() + _KEEP_S
        else:
            self._latecomer.stop()
            job.until_s = job.answer_s

    def _kept(self, why_not: str) -> None:
        """The gatekeeper has kept what is accepted, or not."""
        self._trouble = ""
        if why_not:
            self._complain("weights_not_kept", f"accepted weights cannot be kept: {why_not}")
        self._settled(why_not)

    def _settled(self, why_not_kept: str = "") -> None:
        """Answers who waits for what was taken over."""
        job = self._job
        if job is None or not job.answer:
            return
        self._job = None
        answer, facts = job.answer, job.facts
        if why_not_kept and self._port.store is not None:
            answer, facts = (
                f"{answer}; not kept: {why_not_kept}",
                {**facts, _NOT_KEPT: why_not_kept},
            )
        if job.request is not None:
            reply(job.request, True, answer, facts)
        event = "weights_accepted" if job.kind == "weights" else "weights_rolled_back"
        self._announce(event, answer, facts)

    def _complain(self, kind: str, text: str) -> None:
        self._trouble = text
        _log.warning("%s", text)
        self._announce(kind, text, {})
