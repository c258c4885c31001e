"""Between the learning job and the controller: what is sent, what is answered, what is in use."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

from bayesrace.errors import InputError
from bayesrace.files import read_whole
from bayesrace.gp.weights import MAX_BYTES
from bayesrace.messages import STATUS, Event, Reply, StatusRequest
from bayesrace.transport import ask, send_weights
from experiments.learn.feed import Feed, What
from experiments.learn.journal import Journal, UpdateRecord
from experiments.learn.publishing import Answer

__all__ = ["Desk"]


@dataclass(frozen=True)
class _Sent:
    """What came of sending weights: an answer, or why there is none."""

    version: str
    answer: Answer | None
    why_not: str = ""


@dataclass(frozen=True)
class _Asked:
    """What a controller that has appeared drives with; None if it does not say."""

    version: str | None


class Desk:
    """Sends in a thread of its own; everything else is for the job's thread.

    Weights that nobody has answered for, or only with "not now", wait for a controller. Weights
    that a controller has refused, or returned from, are never sent again.
    """

    def __init__(
        self, session: Any, name: str, journal: Journal, feed: Feed, say: Callable[[str], None]
    ) -> None:
        self._session, self._name = session, name
        self._journal, self._feed, self._say = journal, feed, say
        self._thread = ThreadPoolExecutor(1, "learn-desk")
        self._pending = 0
        self._there = False
        self._closed = False
        self._in_use = ""

    @property
    def busy(self) -> bool:
        """An answer is being waited for."""
        return self._pending > 0

    @property
    def in_use(self) -> str:
        """Version that the controller drives with, as far as it has been told; else empty."""
        return self._in_use

    def offer(self, update: UpdateRecord) -> None:
        """Sends the weights of an update, unless nobody would want them."""
        version = update.version
        if self._journal.declined(version):
            self._settle(version, "not sent", "the same weights have been declined before")
        elif version == self._in_use:
            self._settle(version, "accepted", "in use already")
        elif not self._there:
            self._say(f"no controller of car '{self._name}' is there; {version} waits for one")
        else:
            self._send(update)

    def presence(self, there: bool) -> None:
        """The controller has come or gone."""
        came, self._there = there and not self._there, there
        if came:
            self._do(self._ask_status)
        elif not there:
            self._say("the controller is gone; waiting for it")

    def event(self, event: Event) -> None:
        """What the controller says of weights, whoever has sent them."""
        if event.source != "controller" or not event.kind.startswith("weights_"):
            return
        version = str(event.data.get("version", ""))
        if event.kind == "weights_accepted":
            self._in_use = version
            update = self._journal.update_of(version)
            # Else the answer tells, or has told; it may be late, or lost, and yet they drive.
            if update is not None and update.verdict in ("waiting", "no answer"):
                self._accepted(Answer.of(Reply(0, 0, True, event.text, event.data)))
        if event.kind != "weights_rolled_back":
            return
        given_up = str(event.data.get("from_version", ""))
        self._in_use = version
        update = self._journal.change_update(given_up, verdict="rolled back", answer=event.text)
        ours = "" if update is None else f" (learned after lap {update.after_lap})"
        self._say(f"rolled back: {given_up}{ours}: {event.text}")

    def answer(self, told: Any) -> None:
        """What the thread brings back."""
        self._pending -= 1
        if isinstance(told, _Asked):
            self._arrived(told.version)
            return
        if told.answer is None:
            self._unanswered(told.version, told.why_not)
        elif told.answer.again:
            self._unanswered(told.version, told.answer.words)
        elif not told.answer.accepted:
            self._settle(told.version, "refused", told.answer.text)
        else:
            self._in_use = told.version
            self._accepted(replace(told.answer, version=told.version))

    def close(self) -> None:
        """Nothing more is sent: what waits is for the next job."""
        self._closed = True

    def wait(self) -> None:
        """After :meth:`close`: until an answer under way is there for :meth:`answer`."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _unanswered(self, version: str, why: str) -> None:
        """They may still be accepted: the newest are sent to the next controller that appears."""
        self._say(f"{version}: {why}")
        update = self._journal.update_of(version)
        if update is None or version == self._in_use:  # an event has been faster
            return
        newest = update is self._journal.record.updates[-1]
        if update.verdict == "waiting" or (update.verdict == "accepted" and newest):
            self._journal.change_update(
                version, verdict="waiting", answer=why, cycle=None, acceptance=None
            )

    def _accepted(self, answer: Answer) -> None:
        """Notes it, unless an event or an answer has been faster: what that says is newer."""
        update = self._journal.update_of(answer.version)
        if update is None or update.verdict == "rolled back":
            return
        noted = update.verdict, update.cycle, update.acceptance
        if noted != ("accepted", answer.cycle, answer.acceptance):
            numbers = {"cycle": answer.cycle, "acceptance": answer.acceptance}
            self._settle(answer.version, "accepted", answer.words, **numbers)

    def _arrived(self, version: str | None) -> None:
        """A controller is there and drives with that."""
        before, self._in_use = self._in_use, self._in_use if version is None else version
        waiting = self._journal.record.updates[-1:]
        if waiting and waiting[0].verdict == "waiting" and waiting[0].version:
            self.offer(waiting[0])
            return
        ours = self._journal.update_of(before)
        if version is not None and version != before and ours and ours.verdict == "accepted":
            self._say(f"the controller has come back with {version or 'no weights'}")
            self._send(ours)

    def _send(self, update: UpdateRecord) -> None:
        try:
            data = read_whole(self._journal.path(update.file), "weights file", MAX_BYTES)
        except InputError as error:
            self._say(f"{update.version}: {error}")
        else:
            self._do(self._exchange, update.version, data)

    def _do(self, work: Callable[..., None], *arguments: Any) -> None:
        """In the thread, unless this is closed."""
        if not self._closed:
            self._pending += 1
            self._thread.submit(work, *arguments)

    def _exchange(self, version: str, data: bytes) -> None:
        """In the thread."""
        try:
            sent = _Sent(version, Answer.of(send_weights(self._session, self._name, data)))
        except InputError as error:
            sent = _Sent(version, None, str(error))
        except Exception as error:  # the session has been closed, say: the job must not wait on
            sent = _Sent(version, None, f"no answer: {error}")
        self._feed.put(What.ANSWER, sent)

    def _ask_status(self) -> None:
        """In the thread."""
        version: str | None = None
        try:
            request = StatusRequest(0, time.monotonic_ns())
            version = ask(self._session, STATUS, self._name, request, "controller").weights_version
        except Exception:  # it does not say, or is gone again
            version = None
        self._feed.put(What.ANSWER, _Asked(version))

    def _settle(self, version: str, verdict: str, answer: str, **numbers: int | None) -> None:
        self._journal.change_update(version, verdict=verdict, answer=answer, **numbers)
        refused = "refused: " if verdict == "refused" else ""
        self._say(f"{version}: {refused}{answer}")
