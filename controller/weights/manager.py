"""Takes new weights from a request into the control loop and the store, in a thread of its own.

What takes long is done elsewhere, without the interpreter's lock that the control thread needs:
another process judges, compiled code copies.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from queue import Empty, Full, Queue
from typing import Any, Final

from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import Adopter, AgainError, Ruling, WeightsPort
from bayesrace.controller.weights.checks import judged
from bayesrace.controller.weights.store import AcceptedWeights, digest_of
from bayesrace.defaults import LEAST_LOSS_S
from bayesrace.errors import InputError
from bayesrace.manifest import read_manifest
from bayesrace.messages import ROLLBACK, WEIGHTS, Scalar
from bayesrace.transport import Request, declare_service, decode_request
from bayesrace.vehicles import car_text

__all__ = ["WeightUpdateManager"]

_log = logging.getLogger("bayesrace.controller")

_RETURN_S: Final = 5.0
"""Share of a service's time for the adoption, the store, and the way here and back."""
_END_S: Final = 5.0
"""For the request at hand when the controller ends."""
_POLL_S: Final = 0.02
"""Between two looks at what the watch has found."""

_MOST_WAITING: Final = 32
"""Requests; each may hold a file."""
_FILE_BYTES: Final = 200_000
"""Of a weights file, beyond the arrays of its outputs."""

_Data = Mapping[str, Scalar]
_Answer = tuple[str, _Data]
"""Text and data of an answer that accepts a request; a refusal is an InputError."""

_AGAIN: Final[_Data] = {"again": True}
"""Data of a refusal whose reason passes: the same request may be accepted later."""


class _RefusalError(InputError):
    """A refusal with data."""

    def __init__(self, text: str, data: _Data) -> None:
        super().__init__(text)
        self.data = data


class WeightUpdateManager:
    """Runs from :meth:`start` to :meth:`stop`."""

    def __init__(
        self, session: Any, name: str, port: WeightsPort, adoption: Adopter,
        settings: GateSettings, announce: Callable[[str, str, _Data], None],
    ) -> None:  # fmt: skip
        """``announce`` publishes an event (kind, text, data)."""
        self._port, self._history, self._settings = port, port.history, settings
        self._announce, self.adoption = announce, adoption
        adoption.ruled = self._enter
        self.text = ""
        """What is wrong; empty while all is well."""
        self._counts = dict.fromkeys(("accepted", "refused", "rolled_back"), 0)
        self._counting, self._stopping = threading.Lock(), False
        self._waiting: Queue[tuple[float, int, Request]] = Queue(_MOST_WAITING)
        self._most_bytes = 3 * 8 * 7 * (read_manifest(port.artefact).gp_capacity + 1) + _FILE_BYTES
        self._thread = threading.Thread(target=self._run, name="weights", daemon=True)
        self._name = name
        self.bind(session)

    def bind(self, session: Any) -> None:
        """Serves requests of this session from now on."""
        self._services = [
            declare_service(session, service, self._name, self._arrive, self._most_bytes)
            for service in (WEIGHTS, ROLLBACK)
        ]

    def status(self) -> dict[str, Scalar]:
        """Counters by name."""
        return {
            **{f"weights_{name}": count for name, count in self._counts.items()},
            "weights_number": self._history.in_use.number,
            "weights_watched": not self._history.in_use.proven,
            "weights_slowed": self.adoption.slow is not None,
            "adoption_us": self.adoption.us,
            "adoption_longest_us": self.adoption.longest_us,
        }

    def start(self) -> None:
        """Call it before the control thread gets its priority and CPU, which are not for others."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, within seconds whatever it waits for."""
        self._stopping = True
        self._thread.join(_END_S)

    # Requests ------------------------------------------------------------------------------------

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        try:
            self._waiting.put_nowait((time.monotonic(), self.adoption.reverted, request))
        except Full:
            full = f"{_MOST_WAITING} requests wait already: try later"
            self._answer(request, False, full, _AGAIN)

    def _answer(self, request: Request, accepted: bool, text: str, data: _Data) -> None:
        """Sends the answer, from any thread; every refusal of weights is counted."""
        if not accepted and request.service is WEIGHTS:
            with self._counting:
                self._counts["refused"] += 1
        request.reply(accepted, text, dict(data))

    def _run(self) -> None:
        while not self._stopping:
            try:
                self.adoption.follow()
                self._serve(*self._waiting.get(timeout=_POLL_S))
            except Empty:
                continue
            except Exception:  # without this thread nothing could be published any more
                _log.exception("weights: a fault of the controller's own")

    def _serve(self, arrived_s: float, reverted: int, request: Request) -> None:
        """From a request to its answer; ``reverted``: as often the watch had gone back before."""
        self.adoption.follow()
        due_s = arrived_s + request.service.timeout_s - _RETURN_S
        accepted, text, data = False, "a fault of the controller's own: see its log", _AGAIN
        try:
            serve = self._update if request.service is WEIGHTS else self._back
            text, data = serve(request, reverted, due_s)
            accepted = True
        except AgainError as refusal:
            text = str(refusal)
        except InputError as refusal:
            text, data = str(refusal), getattr(refusal, "data", {})
        finally:
            if not accepted and request.service is WEIGHTS:
                self._announce("weights_refused", text, data)
            self._answer(request, accepted, text, data)

    def _update(self, request: Request, reverted: int, due_s: float) -> _Answer:
        """Judges, stages, adopts and keeps the weights of a request."""
        data, history, watched = request.payload, self._history, self._settings.watch_s > 0
        if request.size > self._most_bytes:
            raise InputError(f"{request.size} bytes are more than any weights that would fit")
        if digest_of(data) in history.withdrawn:
            why_not = "these weights have been rolled back before: they predicted worse than others"
            raise InputError(f"{why_not}; train again")
        verdict = self._judge(data, reverted, due_s)
        if not verdict["packed"]:
            raise _RefusalError(verdict["text"], verdict["data"])
        version, packed = verdict["data"]["version"], verdict["packed"]
        cycle = self.adoption.adopt(packed, version, watched, reverted)
        new = history.accept(version, data, packed, proven=not watched)
        self._counts["accepted"] += 1
        in_use = f"in use from cycle {cycle} on, as number {new.number}"
        text = f"weights {new.version} {in_use}; {verdict['text']}"
        unknown_s = self.adoption.unknown_s
        if unknown_s >= LEAST_LOSS_S:
            where = "where the line is faster than what they have learned"
            text += f"; {unknown_s:.2f} s a lap are lost {where}: train on a track with such bends"
        facts = {
            "number": new.number, "cycle": cycle, "adoption_us": self.adoption.us,
            "unknown_s": unknown_s,
        }  # fmt: skip
        facts = verdict["data"] | facts | request.by
        self._announce("weights_accepted", text, facts)
        return self._kept(text, facts)

    def _judge(self, data: bytes, reverted: int, due_s: float) -> Any:
        """The verdict of another process, by what is in use now."""
        recent = self.adoption.samples(reverted)
        in_use = self._history.in_use
        question = {
            "artefact": str(self._port.artefact), "car": car_text(self._port.car),
            "settings": self._settings.model_dump_json(), "data": data,
            **{name: array.tobytes() for name, array in recent._asdict().items()},
            "in_use": in_use.data, "reference": self._history.reference.data,
            "accepted_utc_ns": in_use.accepted_utc_ns,
        }  # fmt: skip
        try:
            return judged(question, due_s)
        except InputError as error:
            raise AgainError(f"{error}; send them again") from None

    def _back(self, request: Request, reverted: int, due_s: float) -> _Answer:
        """Returns to the weights before those in use."""
        message, why_not = decode_request(request)
        if message is None:
            raise InputError(why_not)
        if reverted != self.adoption.reverted:
            raise InputError("the watch has rolled back meanwhile")
        if len(entries := self._history.entries) < 2:
            raise InputError("there are no weights before those in use")
        target = entries[-2]
        history = self._history.model_copy()
        history.roll_back(target, withdraw=False)
        why, proven = f"on request: {message.text}", history.reference
        if not target.proven:  # the watch over it goes back to what was proven then
            halfway = self.adoption.adopt(proven.packed, proven.version, False, reverted)
        try:
            cycle = self.adoption.adopt(target.packed, target.version, not target.proven, reverted)
        except InputError as error:
            if target.proven or self.adoption.restarted:  # what drives now is not known
                raise
            self._rolled_back(proven, "request", f"{why}; only half the way", halfway)
            self._keep()
            raise InputError(
                f"{error}; weights {proven.version or 'none'} are in use now"
            ) from None
        return self._kept(*self._rolled_back(target, "request", why, cycle))

    def _kept(self, text: str, data: _Data) -> _Answer:
        """The answer after an adoption: weights may be in use and not kept."""
        self._keep()
        if self.text:
            return f"{text}; not kept: {self.text}", {**data, "not_kept": self.text}
        return text, data

    def _keep(self) -> None:
        """Writes the store; if it cannot, the car is driven on with what is in use."""
        self.text = ""
        if self._port.store is None:
            return
        try:
            self._port.store.keep(self._history)
        except InputError as error:
            self.text = str(error)
            _log.warning("%s", error)
            self._announce("weights_not_kept", self.text, {})

    # Watch ---------------------------------------------------------------------------------------

    def _enter(self, cycle: int, ruling: Ruling) -> None:
        """Records a ruling of the watch in the history."""
        in_use = self._history.in_use
        known: _Data = {
            "version": in_use.version, "number": in_use.number, "cycle": cycle,
        }  # fmt: skip
        if ruling.action == "slow":
            limit_mps = ruling.limit_mps
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
        self._keep()

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
