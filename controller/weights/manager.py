"""Takes new weights from a request into the control loop and the store, in a thread of its own.

What takes long is done elsewhere, without the interpreter's lock that the control thread needs:
another process judges, compiled code copies, a third thread writes the store.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from queue import Empty, Full, Queue
from typing import Any, Final

from bayesrace.controller.interface import Controller
from bayesrace.controller.weights.adoption import Adoption, Offer, Ruling, WeightsPort
from bayesrace.controller.weights.checks import NO_SAMPLES, judged
from bayesrace.controller.weights.settings import GateSettings
from bayesrace.controller.weights.store import AcceptedWeights, StoreWriter, digest_of
from bayesrace.errors import InputError
from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, Scalar
from bayesrace.transport import Request, declare_service, decode_request
from bayesrace.vehicles import car_text

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

_MOST_WAITING: Final = 32
"""Requests; each may hold a file."""
_FILE_BYTES: Final = 200_000
"""Of a weights file, beyond the arrays of its outputs."""

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
    """Runs from :meth:`start` to :meth:`stop`."""

    def __init__(
        self, session: Any, name: str, port: WeightsPort, settings: GateSettings, *,
        user: Controller, announce: Callable[[str, str, _Data], None],
    ) -> None:  # fmt: skip
        """``user``: the controller, whose weights the control thread exchanges. ``announce``
        publishes an event (kind, text, data), and is called from several threads."""
        self._port, self._history, self._settings = port, port.history, settings
        self._publish, self.adoption = announce, Adoption(port, settings, user)
        self._writer: StoreWriter | None = None
        if port.store is not None:
            self._writer = StoreWriter(port.store, port.history, self._not_kept)
        self._adoption_us, self._entered, self._rolled_back_s = 0.0, 0, -math.inf
        """Duration of the newest adoption; rulings that are in the history; and the monotonic clock
        when the watch has last rolled back."""
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
        return self._writer.trouble if self._writer else ""

    def status(self) -> dict[str, Scalar]:
        """Counters by name."""
        return {
            **{f"weights_{name}": count for name, count in self._counts.items()},
            "weights_number": self._history.in_use.number,
            "weights_watched": not self._history.in_use.proven,
            "weights_slowed": self.adoption.slow is not None,
            "adoption_us": self._adoption_us,
            "adoption_longest_us": self.adoption.longest_us,
        }

    def start(self) -> None:
        """Call it before the control thread gets its priority and CPU, which are not for others."""
        self._thread.start()

    def stop(self) -> None:
        """Refuses what is not answered, and ends the thread; within seconds, even if the disk of
        the store hangs."""
        self._stopping = True
        self._thread.join()
        self._refuse_waiting()
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
                self._follow()
                self._serve(*self._waiting.get(timeout=_POLL_S))
            except Empty:
                continue
            except Exception:  # without this thread nothing could be published any more
                _log.exception("weights: a fault of the controller's own")

    def _serve(self, arrived_s: float, request: Request) -> None:
        """From a request to its answer."""
        self._follow()
        due_s = arrived_s + request.service.timeout_s - _RETURN_S - _STORE_S
        accepted, text, data = False, "a fault of the controller's own: see its log", _AGAIN
        try:
            if request.service is WEIGHTS:
                text, data = self._update(request, due_s)
            else:
                text, data = self._back(request, arrived_s, due_s)
            accepted = True
        except InputError as refusal:
            text, data = str(refusal), getattr(refusal, "data", {})
        finally:
            self._answer(request, accepted, text, data)
            if not accepted and request.service is WEIGHTS:
                self._announce("weights_refused", text, data)

    def _update(self, request: Request, due_s: float) -> _Answer:
        """Judges, stages, adopts and keeps the weights of a request."""
        data, history, watched = request.payload, self._history, self._settings.watch_s > 0
        if request.size > self._most_bytes:
            raise InputError(f"{request.size} bytes are more than any weights that would fit")
        verdict = self._judge(data, due_s)
        if digest_of(data) in history.withdrawn:
            why_not = "these weights have been rolled back before: they predicted worse than others"
            raise InputError(f"{why_not}; train again")
        if not verdict["packed"]:
            raise _RefusalError(verdict["text"], verdict["data"])
        version = verdict["data"]["version"]
        offer = self._adopt(verdict["packed"], version, watched, due_s)
        new = history.accept(version, data, proven=not watched)
        self._counts["accepted"] += 1
        in_use = f"in use from cycle {offer.cycle} on, as number {new.number}"
        text = f"weights {new.version} {in_use}; {verdict['text']}"
        facts = {"number": new.number, "cycle": offer.cycle, "adoption_us": offer.us}
        facts = verdict["data"] | facts
        self._announce("weights_accepted", text, facts)
        return self._kept(text, facts, offer, due_s)

    def _back(self, request: Request, arrived_s: float, due_s: float) -> _Answer:
        """Returns to the weights before those in use."""
        message, why_not = decode_request(request)
        if message is None:
            raise InputError(why_not)
        if arrived_s < self._rolled_back_s:
            raise InputError("the watch has rolled back meanwhile")
        if len(entries := self._history.entries) < 2:
            raise InputError("there are no weights before those in use")
        target = entries[-2]
        history = self._history.model_copy()
        history.roll_back(target, withdraw=False)
        if not target.proven:  # the watch over it goes back to what was proven then
            proven = history.reference
            self._adopt(proven.packed, proven.version, False, due_s)
        offer = self._adopt(target.packed, target.version, not target.proven, due_s)
        why = f"on request: {message.text}"
        text, data = self._rolled_back(target, "request", why, offer.cycle)
        return self._kept(text, data, offer, due_s)

    def _kept(self, text: str, data: _Data, offer: Offer, due_s: float) -> _Answer:
        """Waits for the store; the answer is true when it is sent.

        InputError if the watch has rolled back meanwhile.
        """
        writer, late = self._writer, ""
        if writer:
            writer.write()
        try:
            why_not = "the store has not been written in time"
            self._wait(lambda: not writer or writer.idle, due_s + _STORE_S, why_not)
        except _RefusalError as error:
            late = str(error)
        self._follow()
        if self.adoption.reverted != offer.reverted:
            now = f"{self._history.in_use.version or 'no weights'} are in use again"
            raise InputError(f"the watch has rolled back meanwhile: {now}; before that, {text}")
        if not_kept := late or (writer.trouble if writer else ""):
            text, data = f"{text}; not kept: {not_kept}", {**data, "not_kept": not_kept}
        return text, data

    def _wait(self, done: Callable[[], object], until_s: float, why_not: str) -> None:
        """Follows the watch until ``done``; refuses the request for now when time is over."""
        while not done():
            if self._stopping or time.monotonic() > until_s:
                raise _RefusalError(_ENDS if self._stopping else why_not)
            time.sleep(_POLL_S)
            self._follow()

    def _judge(self, data: bytes, due_s: float) -> Mapping[str, Any]:
        """The verdict of another process, by what is in use now."""
        history, adoption = self._history, self.adoption
        adoption.samples, adoption.samples_wanted = None, True
        with suppress(_RefusalError):  # without the car's samples, on probation
            until_s = min(time.monotonic() + _ADOPT_S, due_s)
            self._wait(lambda: adoption.samples is not None, until_s, "no samples")
        recent = adoption.samples or NO_SAMPLES
        question = {
            "artefact": str(self._port.artefact), "car": car_text(self._port.car),
            "settings": self._settings.model_dump_json(), "data": data,
            "features": recent.features.tobytes(), "residuals": recent.residuals.tobytes(),
            "in_use": history.in_use.data, "reference": history.reference.data,
            "accepted_utc_ns": history.in_use.accepted_utc_ns,
        }  # fmt: skip
        try:
            verdict: Mapping[str, Any] = judged(question, due_s, self._follow_or_end)
        except _RefusalError:
            raise
        except InputError as error:
            raise _RefusalError(f"{error}; send them again") from None
        return verdict

    def _follow_or_end(self) -> None:
        self._follow()
        if self._stopping:
            raise _RefusalError(_ENDS)

    # Adoption and watch --------------------------------------------------------------------------

    def _adopt(self, packed: bytes, version: str, watched: bool, due_s: float) -> Offer:
        """Stages weights and waits until the control thread has adopted them."""
        offer = Offer(version, self.adoption.reverted, watched)
        self._port.step.stage_weights(packed)
        self.adoption.offers.append(offer)
        until_s = min(time.monotonic() + _ADOPT_S, due_s)
        while not offer.done:
            time.sleep(_POLL_S)
            if self._stopping or time.monotonic() > until_s:
                why_not = f"the control loop did not adopt them within {_ADOPT_S:g} s"
                with suppress(IndexError):  # else the control thread is just adopting them
                    self.adoption.offers.pop()
                    raise _RefusalError(_ENDS if self._stopping else why_not)
        self._follow(offer.ruled)
        if offer.error:
            raise _RefusalError(offer.error)
        self._adoption_us = offer.us
        return offer

    def _follow(self, count: float = math.inf) -> None:
        """Records the watch's rulings in the history, in order. With ``count``, stops after that
        many in all: later ones are about weights just adopted, which are not in the history."""
        while self.adoption.rulings and self._entered < count:
            self._entered += 1
            self._enter(*self.adoption.rulings.popleft())

    def _enter(self, cycle: int, ruling: Ruling) -> None:
        in_use = self._history.in_use
        known: _Data = {"version": in_use.version, "number": in_use.number}
        if ruling.action == "slow":
            limit_mps = self.adoption.slow.speed_limit_mps if self.adoption.slow else 0.0
            text = f"at most {limit_mps:.2f} m/s until other weights are in use"
            data = {**ruling.data, **known, "speed_limit_mps": limit_mps}
            self._announce("weights_slowed", f"{text}; {in_use.version} {ruling.text}", data)
            return
        if ruling.action == "proven":
            self._history.prove()
            text = f"weights {in_use.version} (number {in_use.number}) are proven"
            self._announce("weights_proven", text, known)
        else:
            why = f"{in_use.version} {ruling.text}"
            self._rolled_back(self._history.reference, "watch", why, cycle, ruling.data)
            self._rolled_back_s = time.monotonic()
        if self._writer:
            self._writer.write()

    def _rolled_back(
        self, target: AcceptedWeights, by: str, why: str, cycle: int, data: _Data | None = None
    ) -> _Answer:
        """Enters that earlier weights are in use again."""
        left = self._history.in_use
        self._history.roll_back(target, withdraw=by == "watch")
        self._counts["rolled_back"] += 1
        what = target.version or "no weights, as at the start"
        text = f"back to {what} (number {target.number}) from cycle {cycle} on; {why}"
        facts: _Data = {
            **(data or {}), "version": target.version, "number": target.number, "by": by,
            "cycle": cycle, "from_version": left.version, "from_number": left.number,
        }  # fmt: skip
        self._announce("weights_rolled_back", text, facts)
        return text, facts

    def _not_kept(self, text: str) -> None:
        """Reports that the store cannot be written; the car is driven on with what is in use."""
        _log.warning("%s", text)
        self._announce("weights_not_kept", text, {})

    def _announce(self, kind: str, text: str, data: _Data) -> None:
        """Publishes an event, on which no answer and no rollback depends."""
        try:
            self._publish(kind, text, data)
        except Exception:
            _log.exception("weights: the event %s cannot be published", kind)
