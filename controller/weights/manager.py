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
from contextlib import suppress
from queue import Empty, Full, Queue
from typing import Any, Final, NamedTuple

from bayesrace.errors import InputError
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, Scalar
from bayesrace.transport import Request, declare_service, decode_request
from bayesrace.vehicles import car_text
from controller.native_step import unpack_weights
from controller.weights.adoption import Adoption, Offer, WeightsPort
from controller.weights.settings import GateSettings
from controller.weights.states import SharedStates
from controller.weights.store import AcceptedWeights, Store, digest_of
from controller.weights.supervisor import Supervisor

__all__ = ["WeightUpdateManager"]

_log = logging.getLogger("bayesrace.controller")

_RETURN_S: Final = 2.0
_STORE_S: Final = 5.0
"""Shares of a service's time: for the way here and back, for the store after the adoption."""
_ADOPT_S: Final = 5.0
"""The control loop, driving or idle, adopts within a cycle or a heartbeat; this is a stall."""

_POLL_S: Final = 0.005
"""Between two looks for an answer: the control thread wakes no other thread."""
_WATCH_POLL_S: Final = 0.02
_IDLE_POLL_S: Final = 0.1

_MOST_WAITING: Final = 32
"""Requests; each may hold a file."""
_FILE_BYTES: Final = 100_000
"""Of a weights file, beyond its arrays."""

_Data = dict[str, Scalar]
_Outcome = tuple[bool, str, _Data]
"""Whether a request is accepted, with text and data of answer and event."""

_ENDS: Final = "the controller ends"
_NOT_NOW: Final[_Data] = {"again": True}
"""Data of a :class:`_NotNowError`."""


class _NotNowError(InputError):
    """A refusal whose reason passes: the same request may be accepted later."""


class _Pending(NamedTuple):
    """A request that has not been answered; times by the monotonic clock."""

    request: Request
    arrived_s: float
    due_s: float
    """Deadline of the adoption; the answer may wait for the store for ``_STORE_S`` longer."""

    def reply(self, accepted: bool, text: str, data: Mapping[str, Scalar]) -> None:
        self.request.answer(
            Reply(
                seq=0,
                source_time_ns=time.monotonic_ns(),
                accepted=accepted,
                text=text[:2000],
                data=dict(data),
            )
        )


class WeightUpdateManager:
    """Runs from :meth:`start` to :meth:`stop`, with its validator."""

    def __init__(
        self, session: Any, name: str, port: WeightsPort, settings: GateSettings, *,
        adopt: Callable[[str], None], announce: Callable[[str, str, Mapping[str, Scalar]], None],
    ) -> None:  # fmt: skip
        """``adopt``: see :class:`Adoption`. ``announce`` publishes an event (kind, text, data), and
        is called from several threads."""
        self._port, self._history, self._settings = port, port.history, settings
        self._publish, self._states = announce, SharedStates()
        self.adoption = Adoption(self._states, adopt, watched=not self._history.in_use.proven)
        self._supervisor = Supervisor(self._states, settings.hang_s, self._context, self._lost)
        self._revision = self._begin = self._checks = 0
        """Adoptions, states recorded before the newest, files that the validator was sent."""
        self._verdict: Mapping[str, Any] | None = None
        self._rolled_back_s = -math.inf
        self._counts = {"weights_accepted": 0, "weights_refused": 0, "weights_rolled_back": 0}
        self._trouble, self._stopping = "", False
        self._writer = ThreadPoolExecutor(1, "weights-store")
        self._writing: Future[None] | None = None
        self._waiting: Queue[_Pending] = Queue(_MOST_WAITING)
        self._most_bytes = 3 * 8 * 7 * (port.step.manifest.gp_capacity + 1) + _FILE_BYTES
        self._thread = threading.Thread(target=self._run, name="weights")
        self._services = [
            declare_service(session, service, name, self._arrive, self._most_bytes)
            for service in (WEIGHTS, ROLLBACK)
        ]

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
        self._refuse_waiting()
        self._writer.shutdown(wait=False)
        self._supervisor.close()

    # Receiving -----------------------------------------------------------------------------------

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        now_s = time.monotonic()
        due_s = now_s + request.service.timeout_s - _RETURN_S - _STORE_S
        pending = _Pending(request, now_s, due_s)
        try:
            self._waiting.put_nowait(pending)
        except Full:
            pending.reply(False, f"{_MOST_WAITING} requests wait already: try later", _NOT_NOW)
        if self._stopping and not self._thread.is_alive():  # so no request is left behind
            self._refuse_waiting()

    def _refuse_waiting(self) -> None:
        with suppress(Empty):
            while True:
                self._waiting.get_nowait().reply(False, _ENDS, _NOT_NOW)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._follow()
                idle = self._supervisor.ready and self._history.in_use.proven
                self._serve(self._waiting.get(timeout=_IDLE_POLL_S if idle else _WATCH_POLL_S))
            except Empty:
                continue
            except Exception:  # without this thread bad weights would not be rolled back
                _log.exception("weights: a fault of the controller's own")
                self._supervisor.lose("was ended after a fault of the controller's own")

    def _serve(self, pending: _Pending) -> None:
        """From a request to its answer."""
        back = pending.request.service is ROLLBACK
        try:
            accepted, text, data = (self._back if back else self._update)(pending)
        except InputError as refusal:
            accepted, text = False, str(refusal)
            data = _NOT_NOW if isinstance(refusal, _NotNowError) else {}
        except Exception:
            pending.reply(False, "a fault of the controller's own: see its log", _NOT_NOW)
            raise
        pending.reply(accepted, text, data)
        if accepted:
            self._announce("weights_rolled_back" if back else "weights_accepted", text, data)
        elif not back:
            self._counts["weights_refused"] += 1
            self._announce("weights_refused", text, data)

    def _update(self, pending: _Pending) -> _Outcome:
        """Validates, stages, adopts and keeps the weights of a request."""
        data, size, history = pending.request.payload, pending.request.size, self._history
        if size > self._most_bytes:
            raise InputError(f"{size} bytes are more than any weights that would fit")
        self._check_not_withdrawn(data)
        verdict = self._judge(data, pending.due_s)
        self._check_not_withdrawn(data)  # meanwhile the watch may have rolled them back
        facts, packed, watched = verdict["data"], verdict["packed"], self._settings.watch_s > 0
        if not verdict["accepted"]:
            return False, verdict["text"], facts
        offer = self._adopt(packed, facts["version"], watched, pending.due_s)
        new = history.accept(facts["version"], data, packed, proven=not watched)
        self._counts["weights_accepted"] += 1
        facts |= {"number": new.number, "cycle": offer.cycle, "adoption_us": offer.us}
        text = f"in use from cycle {offer.cycle} on, as number {new.number}; {verdict['text']}"
        return self._kept(pending, f"weights {new.version} {text}", facts)

    def _check_not_withdrawn(self, data: bytes) -> None:
        if digest_of(data) in self._history.withdrawn:
            why_not = "these weights have been rolled back before: they predicted worse than others"
            raise InputError(f"{why_not}; train again")

    def _back(self, pending: _Pending) -> _Outcome:
        """Returns to the weights before those in use."""
        message, why_not = decode_request(pending.request)
        if message is not None and pending.arrived_s < self._rolled_back_s:
            why_not = "the watch has rolled back meanwhile"
        elif message is not None and len(self._history.entries) < 2:
            why_not = "there are no weights before those in use"
        if why_not:
            raise InputError(why_not)
        target, why = self._history.entries[-2], f"on request: {message.text}"
        return self._kept(pending, *self._roll_back(target, "request", why, pending.due_s))

    # Validating ----------------------------------------------------------------------------------

    def _judge(self, data: bytes, due_s: float) -> Mapping[str, Any]:
        """The validator's verdict, by what is in use when it is given."""
        compared = -1
        while compared != self._revision or self._verdict is None:
            if self._supervisor.trouble:
                raise _NotNowError(f"{self._supervisor.trouble}; send them again in a moment")
            if self._supervisor.ready and compared != self._revision:
                compared, self._verdict = self._revision, None
                self._checks += 1
                self._supervisor.send({"kind": "check", "check": self._checks, "data": data})
            self._pause(due_s, "the validator has not answered in time")
        return self._verdict

    def _pause(self, until_s: float, why_not: str) -> None:
        """Waits a moment for the validator; refuses the request when time is over."""
        if self._stopping or time.monotonic() > until_s:
            raise _NotNowError(_ENDS if self._stopping else why_not)
        time.sleep(_POLL_S)
        self._follow()

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

    def _context(self) -> dict[str, Any]:
        """What the validator needs to know."""
        in_use, reference = self._history.in_use, self._history.reference
        return {
            "kind": "context", "settings": self._settings.model_dump(),
            "artefact": str(self._port.artefact), "car": car_text(self._port.car),
            "in_use": in_use.data, "accepted_utc_ns": in_use.accepted_utc_ns,
            "reference": reference.data, "watched": not in_use.proven,
            "revision": self._revision, "begin": self._begin,
        }  # fmt: skip

    def _lost(self, text: str) -> None:
        """The validator is gone; the car is driven on with what is in use."""
        _log.warning("%s", text)
        self.adoption.validator = False
        self._announce("validator_ended", text, {})

    def _announce(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        """Publishes an event, on which no answer and no rollback depends."""
        try:
            self._publish(kind, text, data)
        except Exception:
            _log.exception("weights: the event %s cannot be published", kind)

    # Adopting ------------------------------------------------------------------------------------

    def _adopt(self, packed: bytes, version: str, watched: bool, due_s: float) -> Offer:
        """Stages weights and waits until the control thread has adopted them."""
        offer = Offer(version, self._revision + 1, watched)
        self._port.step.stage_weights(unpack_weights(packed))
        self.adoption.offers.append(offer)
        until_s = min(time.monotonic() + _ADOPT_S, due_s)
        while not offer.done:
            time.sleep(_POLL_S)
            if self._stopping or time.monotonic() > until_s:
                why_not = f"the control loop did not adopt them within {_ADOPT_S:g} s"
                with suppress(IndexError):  # else the control thread is just adopting them
                    self.adoption.offers.pop()
                    raise _NotNowError(_ENDS if self._stopping else why_not)
        if offer.error:
            raise InputError(offer.error)
        self._revision, self._begin = offer.revision, offer.states
        return offer

    def _roll_back(
        self, target: AcceptedWeights, by: str, why: str, due_s: float
    ) -> tuple[str, _Data]:
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
            self._keep()
            text = f"weights {new.version} (number {new.number}) are proven"
            self._announce("weights_proven", text, {"version": new.version, "number": new.number})
            return
        why = f"{self._history.in_use.version} {worse}"
        try:
            text, facts = self._roll_back(self._history.reference, "watch", why, math.inf)
        except InputError as refusal:  # the next validator comes to the same result
            self._supervisor.lose(f"was ended, as a rollback is not possible now ({refusal})")
            return
        self._rolled_back_s = time.monotonic()
        self._keep()
        self._announce("weights_rolled_back", text, {**data, **facts})

    # Storing -------------------------------------------------------------------------------------

    def _keep(self) -> "Future[None] | None":
        """Sends the validator what is in use, and has it written to the store."""
        self._supervisor.send(self._context())
        if self._port.store is not None:
            last = self._writing
            if (
                last is None or last.running() or last.done()
            ):  # else it has not begun: one is enough
                self._writing = self._writer.submit(self._write, self._port.store)
        return self._writing

    def _write(self, store: Store) -> None:
        """In the store's thread."""
        try:
            store.keep(self._history.model_copy())
            self._trouble = ""
        except InputError as error:
            self._trouble = f"accepted weights cannot be kept: {error}"
            _log.warning("%s", self._trouble)
            self._announce("weights_not_kept", self._trouble, {})
            raise

    def _kept(self, pending: _Pending, text: str, data: _Data) -> _Outcome:
        """Acceptance, once the store is written; it says if that is not so."""
        writing = self._keep()
        try:
            while writing is not None and not writing.done():
                self._pause(pending.due_s + _STORE_S, "the store has not been written in time")
            error = None if writing is None else writing.exception()
        except _NotNowError as late:
            error = late
        if error is not None:
            text, data = f"{text}; not kept: {error}", {**data, "not_kept": str(error)}
        return True, text, data
