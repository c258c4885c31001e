"""Takes new weights from a request into the control loop and the store, in a thread of its own.

What takes long is done elsewhere, without the interpreter's lock that the control thread needs: the
validator process decodes and judges, the compiled code copies, a third thread writes the store.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import ROLLBACK, Scalar
from bayesrace.transport import decode_request
from bayesrace.vehicles import car_text
from controller.native_step import unpack_weights
from controller.weights.adoption import Adoption, Offer, WeightsPort
from controller.weights.requests import ENDS, PendingRequest, RequestQueue, UpdateRefusedError
from controller.weights.settings import GateSettings
from controller.weights.states import SharedStates
from controller.weights.store import AcceptedWeights, digest_of
from controller.weights.supervisor import Supervisor

__all__ = ["WeightUpdateManager"]

_log = logging.getLogger("bayesrace.controller")

_ADOPT_S: Final = 5.0
"""The control loop, driving or idle, adopts within a cycle or a heartbeat; this is a stall."""

_POLL_S: Final = 0.005
"""Between two looks for an answer: the control thread wakes no other thread."""
_WATCH_POLL_S: Final = 0.02
_IDLE_POLL_S: Final = 0.1

_FILE_BYTES: Final = 100_000
"""Of a weights file, beyond its arrays."""

News = tuple[str, dict[str, Scalar]]
"""Text and data of an answer and an event."""


class WeightUpdateManager:
    """Runs from :meth:`start` to :meth:`stop`, with its validator."""

    def __init__(
        self, session: Any, name: str, port: WeightsPort, settings: GateSettings, *,
        adopt: Callable[[str], None], announce: Callable[[str, str, Mapping[str, Scalar]], None],
    ) -> None:  # fmt: skip
        """``adopt``: see :class:`Adoption`. ``announce`` publishes an event (kind, text, data), and
        is called from several threads."""
        self._port, self._history, self._settings = port, port.history, settings
        self._publish = announce
        self._states = SharedStates()
        self.adoption = Adoption(self._states, adopt, watched=not self._history.in_use.proven)
        self._supervisor = Supervisor(self._states, settings.hang_s, self._context, self._lost)
        self._revision = self._begin = self._checks = 0
        """Adoptions, states recorded before the newest, files that the validator was sent."""
        self._verdict: Mapping[str, Any] | None = None
        self._rolled_back_s = -math.inf
        self._counts = {"weights_accepted": 0, "weights_refused": 0, "weights_rolled_back": 0}
        self._trouble = ""
        self._stopping = False
        self._writer = ThreadPoolExecutor(1, "weights-store")
        self._most_bytes = 3 * 8 * 7 * (port.step.manifest.gp_capacity + 1) + _FILE_BYTES
        self._requests = RequestQueue(session, name, self._most_bytes)
        self._thread = threading.Thread(target=self._run, name="weights")

    @property
    def text(self) -> str:
        """What is wrong; empty while all is well."""
        return "; ".join(filter(None, (self._supervisor.trouble, self._trouble)))

    def status(self) -> dict[str, Scalar]:
        """Counters by name."""
        return {
            **self._counts,
            "weights_number": self._history.in_use.number,
            "weights_watched": not self._history.in_use.proven,
            "validator": self._supervisor.ready,
            "validator_starts": self._supervisor.starts,
            "adoption_us": self.adoption.newest_us,
            "adoption_longest_us": self.adoption.longest_us,
            "watch_missed": self.adoption.missed,
        }

    def start(self) -> None:
        """Call it before the control thread gets its priority and CPU, which are not for others."""
        self._thread.start()

    def stop(self) -> None:
        """Refuses what is not answered, and ends threads and validator."""
        self._stopping = True
        self._thread.join()
        self._supervisor.close()
        self._states.close()

    # The thread ----------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._follow()
                busy = self._history.in_use.proven and self._supervisor.ready
                pending = self._requests.get(_IDLE_POLL_S if busy else _WATCH_POLL_S)
                if pending is not None:
                    self._serve(pending)
            except Exception:  # without this thread bad weights would not be rolled back
                _log.exception("weights: a fault of the controller's own")
                self._supervisor.lose("was ended after a fault of the controller's own")
        self._requests.close()
        self._writer.shutdown(wait=False)

    def _follow(self) -> None:
        """Starts or replaces the validator if need be, and follows its messages."""
        self._supervisor.look()
        while (message := self._supervisor.receive()) is not None:
            match message["kind"]:
                case "ready":
                    self.adoption.validator = True
                case "verdict" if message["check"] == self._checks:
                    self._verdict = message
                case "watch" if message["revision"] == self._revision:
                    self._end_watch(message["worse"], message["data"])

    def _pause(self, until_s: float, why_not: str, follow: bool = True) -> None:
        """Waits a moment; refuses the request when time is over."""
        if self._stopping or time.monotonic() > until_s:
            raise UpdateRefusedError(ENDS if self._stopping else why_not)
        time.sleep(_POLL_S)
        if follow:
            self._follow()

    def _context(self) -> dict[str, Any]:
        """What the validator needs to know."""
        in_use, reference = self._history.in_use, self._history.reference
        return {
            "kind": "context",
            "settings": self._settings.model_dump(),
            "artefact": str(self._port.artefact),
            "car": car_text(self._port.car),
            "in_use": in_use.data,
            "accepted_utc_ns": in_use.accepted_utc_ns,
            "reference": reference.data,
            "watched": not in_use.proven,
            "revision": self._revision,
            "begin": self._begin,
        }

    def _lost(self, text: str) -> None:
        """The validator is gone; the car is driven on with what is in use."""
        self.adoption.validator = False
        _log.warning("%s", text)
        self._announce("validator_ended", text, {})

    def _announce(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        """Answers and rollbacks do not depend on events."""
        try:
            self._publish(kind, text, data)
        except Exception:
            _log.exception("weights: the event %s cannot be published", kind)

    # Requests ------------------------------------------------------------------------------------

    def _serve(self, pending: PendingRequest) -> None:
        """From a request to its answer."""
        back = pending.request.service is ROLLBACK
        try:
            text, data = self._back_on_request(pending) if back else self._update(pending)
        except UpdateRefusedError as refusal:
            pending.reply(False, str(refusal), refusal.data)
            if not back:
                self._counts["weights_refused"] += 1
                self._announce("weights_refused", str(refusal), refusal.data)
        except Exception:
            pending.reply(False, "a fault of the controller's own: see its log")
            raise
        else:
            pending.reply(True, text, data)
            self._announce("weights_rolled_back" if back else "weights_accepted", text, data)

    def _update(self, pending: PendingRequest) -> News:
        """Validates, stages and adopts the weights of a request, and keeps them."""
        data, size = pending.request.payload, pending.request.size
        if size > self._most_bytes:
            raise UpdateRefusedError(f"{size} bytes are more than any weights that would fit", {})
        if digest_of(data) in self._history.withdrawn:
            raise UpdateRefusedError(
                "these weights have been rolled back before, because they predicted worse than "
                "earlier ones; train again", {},
            )  # fmt: skip
        verdict = self._judge(data, pending.due_s)
        facts, packed = verdict["data"], verdict["packed"]
        if not verdict["accepted"]:
            raise UpdateRefusedError(verdict["text"], facts)
        watched = self._settings.watch_s > 0
        offer = self._adopt(packed, facts["version"], watched, pending.due_s)
        new = self._history.accept(facts["version"], data, packed, proven=not watched)
        self._counts["weights_accepted"] += 1
        facts |= {"number": new.number, "cycle": offer.cycle, "adoption_us": offer.us}
        text = (
            f"weights {new.version} in use from cycle {offer.cycle} on, as number {new.number}; "
            f"{verdict['text']}"
        )
        return self._kept(pending, text, facts)

    def _judge(self, data: bytes, due_s: float) -> Mapping[str, Any]:
        """The validator's verdict, on what is in use when it is given."""
        compared = -1
        while compared != self._revision or self._verdict is None:
            if self._supervisor.trouble:
                text = f"{self._supervisor.trouble}; send them again in a moment"
                raise UpdateRefusedError(text)
            if self._supervisor.ready and compared != self._revision:
                compared, self._verdict = self._revision, None
                self._checks += 1
                self._supervisor.send({"kind": "check", "check": self._checks, "data": data})
            self._pause(due_s, "the validator has not answered in time")
        return self._verdict

    def _back_on_request(self, pending: PendingRequest) -> News:
        """Returns to the weights before those in use."""
        message, why_not = decode_request(pending.request)
        if message is None:
            raise UpdateRefusedError(why_not, {})
        if pending.arrived_s < self._rolled_back_s:
            raise UpdateRefusedError("the watch has rolled back meanwhile", {})
        if len(self._history.entries) < 2:
            raise UpdateRefusedError("there are no weights before those in use", {})
        target, why = self._history.entries[-2], f"on request: {message.text}"
        text, data = self._roll_back(target, "request", why, pending.due_s)
        return self._kept(pending, text, data)

    # Adoption ------------------------------------------------------------------------------------

    def _adopt(self, packed: bytes, version: str, watched: bool, due_s: float) -> Offer:
        """Stages weights and waits until the control thread has adopted them."""
        offer = Offer(version, self._revision + 1, watched)
        try:
            self._port.step.stage_weights(unpack_weights(packed))
        except InputError as error:
            raise UpdateRefusedError(str(error), {}) from None
        self.adoption.offers.append(offer)
        until_s = min(time.monotonic() + _ADOPT_S, due_s)
        try:
            while not offer.done:
                why_not = f"the control loop did not adopt them within {_ADOPT_S:g} s"
                self._pause(until_s, why_not, follow=False)
        except UpdateRefusedError:
            if self.adoption.withdraw():
                raise
            while not offer.done:  # the control thread is just adopting them
                time.sleep(_POLL_S)
        if offer.error:
            raise UpdateRefusedError(offer.error, {})
        self._revision, self._begin = offer.revision, offer.states
        return offer

    def _roll_back(self, target: AcceptedWeights, by: str, why: str, due_s: float) -> News:
        """Returns to earlier weights."""
        left = self._history.in_use
        offer = self._adopt(target.packed, target.version, not target.proven, due_s)
        self._history.roll_back(target, withdraw=by == "watch")
        self._counts["weights_rolled_back"] += 1
        what = target.version or "no weights, as at the start"
        text = f"back to {what} (number {target.number}) from cycle {offer.cycle} on; {why}"
        return text, {
            "version": target.version, "number": target.number, "cycle": offer.cycle,
            "from_version": left.version, "from_number": left.number, "by": by,
        }  # fmt: skip

    def _end_watch(self, worse: str, data: Mapping[str, Scalar]) -> None:
        """The watch has a result: the weights in use are proven, or ``worse``."""
        if not worse:
            new = self._history.prove()
            text = f"weights {new.version} (number {new.number}) are proven"
            self._keep()
            self._announce("weights_proven", text, {"version": new.version, "number": new.number})
            return
        why = f"{self._history.in_use.version} {worse}"
        try:
            text, facts = self._roll_back(self._history.reference, "watch", why, math.inf)
        except UpdateRefusedError as refusal:  # the next validator comes to the same result
            self._supervisor.lose(f"was ended, as a rollback is not possible now ({refusal})")
            return
        self._rolled_back_s = time.monotonic()
        self._keep()
        self._announce("weights_rolled_back", text, {**data, **facts})

    # Store ---------------------------------------------------------------------------------------

    def _keep(self) -> "Future[None] | None":
        """Tells the validator what is in use, and begins to write it to the store."""
        self._supervisor.send(self._context())
        if self._port.store is None:
            return None
        writing = self._writer.submit(self._port.store.keep, self._history.model_copy())
        writing.add_done_callback(self._note_store)
        return writing

    def _note_store(self, writing: "Future[None]") -> None:
        """In the store's thread."""
        error = writing.exception()
        self._trouble = f"accepted weights cannot be kept: {error}" if error else ""
        if error:
            _log.warning("%s", self._trouble)
            self._announce("weights_not_kept", self._trouble, {})

    def _kept(self, pending: PendingRequest, text: str, data: dict[str, Scalar]) -> News:
        """The answer, once the store is written; it says if that is not so."""
        writing = self._keep()
        try:
            while writing is not None and not writing.done():
                self._pause(pending.answer_s, "the store has not been written in time")
            error = None if writing is None else writing.exception()
        except UpdateRefusedError as late:
            error = late
        if error is None:
            return text, data
        return f"{text}; not kept: {error}", {**data, "not_kept": str(error)}
