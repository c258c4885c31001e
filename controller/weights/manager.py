"""Takes new weights from a request into the control loop and the store, in a thread of its own.

What takes long is done elsewhere, without the interpreter's lock that the control thread needs: the
validator process decodes and judges, compiled code copies, a third thread writes the store.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from queue import Empty, Full, Queue
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, Scalar
from bayesrace.transport import Request, declare_service, decode_request
from bayesrace.vehicles import car_text
from controller.native_step import unpack_weights
from controller.weights.adoption import Adoption, Offer, WeightsPort, slowed_down
from controller.weights.settings import GateSettings
from controller.weights.store import AcceptedWeights, StoreWriter, digest_of
from controller.weights.supervisor import Supervisor
from controller.weights.validator_client import ValidatorClient

__all__ = ["WeightUpdateManager"]

_log = logging.getLogger("bayesrace.controller")

_RETURN_S: Final = 3.0
_STORE_S: Final = 5.0
"""Shares of a service's time: for the way here and back and a last rollback, and for the store."""
_ADOPT_S: Final = 2.0
"""The control loop, driving or idle, adopts within a cycle or a heartbeat; this is a stall."""
_END_S: Final = 2.0
"""For the store when the controller ends."""

_POLL_S: Final = 0.02
"""Between two looks at what is waited for: the control thread wakes no other thread."""
_LOCKSTEP_POLL_S, _LOCKSTEP_S = 2e-4, 1.0
"""The same in lockstep, where the control loop waits for the watch; and how long after it has."""

_MOST_WAITING: Final = 32
"""Requests; each may hold a file."""
_FILE_BYTES: Final = 100_000
"""Of a weights file, beyond its arrays."""

_Data = Mapping[str, Scalar]
_Answer = tuple[str, _Data]
"""Text and data of an answer that accepts a request; a refusal is an InputError."""

_ENDS: Final = "the controller ends"
_AGAIN: Final[_Data] = {"again": True}
"""Data of a refusal whose reason passes: the same request may be accepted later."""


class _RefusalError(InputError):
    """A refusal with data."""

    def __init__(self, text: str, data: _Data = _AGAIN) -> None:
        super().__init__(text)
        self.data = data


class WeightUpdateManager:
    """Runs from :meth:`start` to :meth:`stop`, with its validator."""

    def __init__(
        self, session: Any, name: str, port: WeightsPort, settings: GateSettings, *,
        adopt: Callable[[str], None], announce: Callable[[str, str, _Data], None],
    ) -> None:  # fmt: skip
        """``adopt``: see :class:`Adoption`. ``announce`` publishes an event (kind, text, data), and
        is called from several threads."""
        self._port, self._history, self._settings = port, port.history, settings
        self._publish, self.adoption = announce, Adoption(adopt)
        arguments = str(port.artefact), settings.model_dump_json(), car_text(port.car)
        lost, not_kept = (
            partial(self._warn, kind) for kind in ("validator_ended", "weights_not_kept")
        )
        self._supervisor = Supervisor(arguments, settings.hang_s, lost)
        self._validator = ValidatorClient(self._supervisor, self.adoption, port.history, self._rule)
        self._writer: StoreWriter | None = None
        if port.store is not None:
            self._writer = StoreWriter(port.store, port.history, not_kept)
        self._adopted = Offer("")
        """The newest adoption; at first of the weights at the start."""
        self._due_s = self._rolled_back_s = -math.inf
        """Monotonic clock: deadline of the request that is served, but for the store; and when the
        watch has rolled back."""
        self._counts = dict.fromkeys(("accepted", "refused", "rolled_back"), 0)
        self._counting, self._stopping = threading.Lock(), False
        self._waiting: Queue[tuple[float, Request]] = Queue(_MOST_WAITING)
        self._most_bytes = 3 * 8 * 7 * (port.step.manifest.gp_capacity + 1) + _FILE_BYTES
        self._thread = threading.Thread(target=self._run, name="weights")
        self._services = [
            declare_service(session, service, name, self._arrive, self._most_bytes)
            for service in (WEIGHTS, ROLLBACK)
        ]

    @property
    def text(self) -> str:
        """What is wrong; empty while all is well."""
        parts = self._supervisor, self._writer
        return "; ".join(part.trouble for part in parts if part and part.trouble)

    def status(self) -> dict[str, Scalar]:
        """Counters by name."""
        return {
            **{f"weights_{name}": count for name, count in self._counts.items()},
            "weights_number": self._history.in_use.number,
            "weights_watched": not self._history.in_use.proven,
            "weights_slowed": self.adoption.slow is not None,
            "validator": self._supervisor.ready,
            "validator_starts": self._supervisor.starts,
            "adoption_us": self._adopted.us,
            "adoption_longest_us": self.adoption.longest_us,
            "watch_missed": self.adoption.missed,
        }

    def start(self) -> None:
        """Call it before the control thread gets its priority and CPU, which are not for others."""
        self._thread.start()

    def stop(self) -> None:
        """Refuses what is not answered, and ends threads and validator; within seconds, even if
        the disk of the store hangs."""
        self._stopping = True
        self._thread.join()
        self._refuse_waiting()
        self._supervisor.close()
        until_s = time.monotonic() + _END_S
        while self._writer and not self._writer.idle and time.monotonic() < until_s:
            time.sleep(_POLL_S)

    # Requests ------------------------------------------------------------------------------------

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        try:
            self._waiting.put_nowait((time.monotonic(), request))
        except Full:
            full = f"{_MOST_WAITING} requests wait already: try later"
            self._answer(request, False, full, _AGAIN)
        if self._stopping and not self._thread.is_alive():  # so no request is left behind
            self._refuse_waiting()

    def _refuse_waiting(self) -> None:
        with suppress(Empty):
            while True:
                self._answer(self._waiting.get_nowait()[1], False, _ENDS, _AGAIN)

    def _answer(self, request: Request, accepted: bool, text: str, data: _Data) -> None:
        """Sends the answer, from any thread; every refusal of weights is counted."""
        if not accepted and request.service is WEIGHTS:
            with self._counting:
                self._counts["refused"] += 1
        now_ns, data = time.monotonic_ns(), dict(data)
        reply = Reply(seq=0, source_time_ns=now_ns, accepted=accepted, text=text[:2000], data=data)
        request.answer(reply)

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._validator.follow()
                self._serve(*self._waiting.get(timeout=self._poll_s))
            except Empty:
                continue
            except Exception:  # without this thread bad weights would not be rolled back
                _log.exception("weights: a fault of the controller's own")
                self._supervisor.lose("was ended after a fault of the controller's own")

    def _serve(self, arrived_s: float, request: Request) -> None:
        """From a request to its answer."""
        self._due_s = arrived_s + request.service.timeout_s - _RETURN_S - _STORE_S
        serve = self._update if request.service is WEIGHTS else self._back
        accepted, text, data = False, "a fault of the controller's own: see its log", _AGAIN
        try:
            text, data = serve(request, arrived_s)
            accepted = True
        except InputError as refusal:
            text, data = str(refusal), getattr(refusal, "data", {})
        finally:
            self._answer(request, accepted, text, data)
            if not accepted and request.service is WEIGHTS:
                self._announce("weights_refused", text, data)

    def _update(self, request: Request, _: float) -> _Answer:
        """Validates, stages, adopts and keeps the weights of a request."""
        data, history, watched = request.payload, self._history, self._settings.watch_s > 0
        if request.size > self._most_bytes:
            raise InputError(f"{request.size} bytes are more than any weights that would fit")
        verdict = self._judge(data)
        if digest_of(data) in history.withdrawn:
            why_not = "these weights have been rolled back before: they predicted worse than others"
            raise InputError(f"{why_not}; train again")
        if not verdict["packed"]:
            raise _RefusalError(verdict["text"], verdict["data"])
        offer = self._adopt(verdict["packed"], verdict["data"]["version"], self._due_s)
        new = history.accept(offer.version, data, verdict["packed"], proven=not watched)
        self._counts["accepted"] += 1
        in_use = f"in use from cycle {offer.cycle} on, as number {new.number}"
        text = f"weights {new.version} {in_use}; {verdict['text']}"
        facts = {"number": new.number, "cycle": offer.cycle, "adoption_us": offer.us}
        facts = verdict["data"] | facts
        self._announce("weights_accepted", text, facts)
        return self._kept(text, facts)

    def _back(self, request: Request, arrived_s: float) -> _Answer:
        """Returns to the weights before those in use."""
        message, why_not = decode_request(request)
        if message is None:
            raise InputError(why_not)
        if arrived_s < self._rolled_back_s:
            raise InputError("the watch has rolled back meanwhile")
        if len(entries := self._history.entries) < 2:
            raise InputError("there are no weights before those in use")
        why = f"on request: {message.text}"
        return self._kept(*self._roll_back(entries[-2], "request", why, self._due_s))

    def _kept(self, text: str, data: _Data) -> _Answer:
        """Waits for the store; the answer is true when it is sent.

        InputError if the watch has rolled back meanwhile.
        """
        adopted, writer, late = self._adopted, self._keep(), ""
        try:
            why_not = "the store has not been written in time"
            self._wait(lambda: not writer or writer.idle, self._due_s + _STORE_S, why_not)
        except _RefusalError as error:
            late = str(error)
        if self._adopted is not adopted:
            now = f"{self._history.in_use.version or 'no weights'} are in use again"
            raise InputError(f"the watch has rolled back meanwhile: {now}; before that, {text}")
        if not_kept := late or (writer.trouble if writer else ""):
            text, data = f"{text}; not kept: {not_kept}", {**data, "not_kept": not_kept}
        return text, data

    def _wait(self, done: Callable[[], object], until_s: float, why_not: str) -> None:
        """Follows the validator until ``done``; refuses the request for now when time is over."""
        while not done():
            if self._stopping or time.monotonic() > until_s:
                raise _RefusalError(_ENDS if self._stopping else why_not)
            time.sleep(self._poll_s)
            self._validator.follow()

    # Validator -----------------------------------------------------------------------------------

    def _judge(self, data: bytes) -> Mapping[str, Any]:
        """The validator's verdict, by what is in use when it is given."""
        validator, late = self._validator, "the validator has not answered in time"
        validator.check(data)
        try:
            self._wait(lambda: validator.verdict or self._supervisor.trouble, self._due_s, late)
        finally:
            validator.check(None)
        if not validator.verdict:
            raise _RefusalError(f"{self._supervisor.trouble}; send them again in a moment")
        return validator.verdict

    @property
    def _poll_s(self) -> float:
        """Time to the next look at what the control thread and the validator have done."""
        lockstep = time.monotonic() < self.adoption.awaited_s + _LOCKSTEP_S
        return _LOCKSTEP_POLL_S if lockstep else _POLL_S

    def _rule(self, action: str, why: str, data: _Data) -> None:
        """Acts on a :class:`.checks.Ruling` about the weights in use."""
        in_use = self._history.in_use
        known: _Data = {"version": in_use.version, "number": in_use.number}
        if action == "slow":
            self._slow_down(f"{in_use.version} {why}", {**data, **known})
            return
        if action == "proven":
            self._history.prove()
            text = f"weights {in_use.version} (number {in_use.number}) are proven"
            self._announce("weights_proven", text, known)
        else:
            why = f"{in_use.version} {why}"
            try:
                self._roll_back(self._history.reference, "watch", why, math.inf, data)
            except InputError as refusal:  # the next validator comes to the same result
                self._supervisor.lose(f"was ended, as a rollback is not possible now ({refusal})")
                return
            self._rolled_back_s = time.monotonic()
        self._keep()

    def _slow_down(self, why: str, data: _Data) -> None:
        """Limits the speed until other weights are in use: going back would be no better."""
        if self.adoption.slow is not None:  # by a validator that has ended meanwhile
            return
        slow = slowed_down(self._settings, self._port.car, float(data["fastest_mps"]))
        self.adoption.slow = slow
        text = f"at most {slow.speed_limit_mps:.2f} m/s until other weights are in use; {why}"
        self._announce("weights_slowed", text, {**data, "speed_limit_mps": slow.speed_limit_mps})

    # Adoption and store --------------------------------------------------------------------------

    def _adopt(self, packed: bytes, version: str, due_s: float, keeps_limit: bool = False) -> Offer:
        """Stages weights and waits until the control thread has adopted them."""
        offer = Offer(version, keeps_limit)
        self._port.step.stage_weights(unpack_weights(packed))
        self.adoption.offers.append(offer)
        until_s = min(time.monotonic() + _ADOPT_S, due_s)
        while not offer.done:
            time.sleep(self._poll_s)
            if self._stopping or time.monotonic() > until_s:
                why_not = f"the control loop did not adopt them within {_ADOPT_S:g} s"
                with suppress(IndexError):  # else the control thread is just adopting them
                    self.adoption.offers.pop()
                    raise _RefusalError(_ENDS if self._stopping else why_not)
        if offer.error:
            raise InputError(offer.error)
        self._adopted = offer
        return offer

    def _roll_back(
        self, target: AcceptedWeights, by: str, why: str, due_s: float, data: _Data | None = None
    ) -> _Answer:
        """Returns to earlier weights."""
        left = self._history.in_use
        offer = self._adopt(target.packed, target.version, due_s, keeps_limit=by == "watch")
        self._history.roll_back(target, withdraw=by == "watch")
        self._counts["rolled_back"] += 1
        what = target.version or "no weights, as at the start"
        text = f"back to {what} (number {target.number}) from cycle {offer.cycle} on; {why}"
        facts: _Data = {
            **(data or {}), "version": target.version, "number": target.number, "by": by,
            "cycle": offer.cycle, "from_version": left.version, "from_number": left.number,
        }  # fmt: skip
        self._announce("weights_rolled_back", text, facts)
        return text, facts

    def _keep(self) -> StoreWriter | None:
        """Has the validator sent what is in use, and the store written."""
        self._validator.renew(self._adopted.states)
        if self._writer:
            self._writer.write()
        return self._writer

    def _warn(self, kind: str, text: str) -> None:
        """Reports trouble, in any thread; the car is driven on with what is in use."""
        _log.warning("%s", text)
        self._announce(kind, text, {})

    def _announce(self, kind: str, text: str, data: _Data) -> None:
        """Publishes an event, on which no answer and no rollback depends."""
        try:
            self._publish(kind, text, data)
        except Exception:
            _log.exception("weights: the event %s cannot be published", kind)
