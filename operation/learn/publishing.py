"""Publishes weights to a controller, and notes whether it accepts and keeps them."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.files import read_whole
from bayesrace.messages import Event, Reply, Status
from bayesrace.operation.learn.records import UpdateRecord, Verdict
from bayesrace.operation.lifecycle import find, pick
from bayesrace.transport import Endpoints, open_session, send_weights

if TYPE_CHECKING:  # with which all of the training is imported
    from bayesrace.operation.learn.journal import Journal

__all__ = ["NotTakenOverError", "Publisher", "accepted", "in_words"]


class NotTakenOverError(RuntimeError):
    """A controller has refused weights or a rollback; the message is its reason."""


def in_words(reply: Reply) -> str:
    """A controller's answer to new weights, or to a rollback, as a text."""
    data = reply.data
    if not reply.accepted:
        return f"refused{' for now, try again' if data.get('again') is True else ''}: {reply.text}"
    if "cycle" not in data:
        return f"taken over: {reply.text}"
    which = f" (acceptance {data['number']})" if "number" in data else ""
    which += f", but not kept: {data['not_kept']}" if "not_kept" in data else ""
    return f"taken over at cycle {data['cycle']}{which}"


def accepted(
    endpoints: Endpoints,
    name: str,
    timeout_s: float | None,
    send: Callable[[Any, str, Any, float], Reply],
    content: Any,
) -> tuple[str, Reply]:
    """What the controller of the car, or of the only one (""), answers to what ``send`` sends, also
    in words; NotTakenOverError if it refuses."""
    name = endpoints.car_named(name)
    with open_session(endpoints, "learning", reports_absence=False) as session:
        found = find(session, endpoints, timeout_s or 5.0, name, ("controller",))
        car = pick(found, name, False)[0]
        reply = send(session, car, content, timeout_s or 20.0)
    if not reply.accepted:
        raise NotTakenOverError(f"{car}: {in_words(reply)}")
    return f"{car}: {reply.data.get('version', '')} {in_words(reply)}", reply


class Publisher:
    """Sends the weights of updates and notes their verdicts; for the job's thread.

    A thread of its own waits for the answers; :meth:`poll` notes those that have arrived. Weights
    without an answer, or refused for now, stay pending: they are sent to the next controller that
    appears. Weights refused or rolled back are not sent again.
    """

    def __init__(self, session: Any, journal: "Journal", say: Callable[[str], None]) -> None:
        self._session, self._journal, self._say = session, journal, say
        self._car = journal.settings.name
        self._thread = ThreadPoolExecutor(1, "learn-publisher")
        self.unanswered: deque[tuple[UpdateRecord, Future[Reply]]] = deque()
        """Updates that were sent, oldest first, with what will be the answer."""
        self.present = False
        """A heartbeat has come since the controller appeared or disappeared."""
        self.closed = False
        """Nothing is sent any more: pending weights are for the next job."""
        self.in_use = ""
        """Version that the controller drives with; empty while that is unknown, or for none."""

    def offer(self, update: UpdateRecord) -> None:
        """Sends the weights of an update if the controller is there and has not declined them."""
        version, updates = update.version, self._journal.record.updates
        verdicts = {one.verdict for one in updates if one.version == version}
        if verdicts & {"refused", "rolled back"}:
            self._note(update, "not sent", "the same weights have been declined before")
        elif version == self.in_use:
            self._note(update, "accepted", "in use already")
        elif self.present:
            self._send(update)
        else:
            self._say(f"no controller of car '{self._car}' is there; {version} is pending")

    def heartbeat(self, status: Status) -> None:
        """Compares the weights that the controller's status names with those sent.

        A controller that has just appeared is sent the pending weights, or else the last accepted
        ones if it drives with others.
        """
        if status.source != "controller":
            return
        appeared, self.present, self.in_use = not self.present, True, status.weights_version
        update, last = self._journal.update_of(self.in_use), self._journal.last_accepted
        pending = [one for one in self._journal.record.updates if one.verdict == "pending"]
        if appeared and pending:
            self.offer(pending[-1])
        elif appeared and last is not None and self.in_use != last.version:
            drives = self.in_use or "no weights"
            self._say(f"the controller drives with {drives}; sending {last.version}")
            self._send(last)
        elif update and update.verdict in ("pending", "superseded") and not self.unanswered:
            self._note(update, "accepted", "in use")  # the answer was lost

    def event(self, event: Event) -> None:
        """Notes what the controller has rolled back."""
        if event.source != "controller" or event.kind != "weights_rolled_back":
            return
        version = str(event.data.get("from_version", ""))
        updates = [one for one in self._journal.record.updates if version == one.version != ""]
        for update in updates:
            update.verdict, update.answer = "rolled back", event.text
        if updates:
            self._journal.save()
            version += f" (learned after lap {updates[-1].after_lap})"
        self._say(f"rolled back: {version}: {event.text}")

    def poll(self) -> None:
        """Notes the answers that have arrived."""
        while self.unanswered and self.unanswered[0][1].done():
            update, request = self.unanswered.popleft()
            if request.cancelled():
                continue
            if error := request.exception():
                self._note(update, update.verdict, str(error))
                continue
            reply = request.result()
            numbers = {name: one for name, one in reply.data.items() if type(one) is int}
            if reply.accepted:
                update.cycle, update.acceptance = numbers.get("cycle"), numbers.get("number")
                self._note(update, "accepted", in_words(reply))
            elif reply.data.get("again") is True:
                self._note(update, update.verdict, in_words(reply))
            else:
                self._note(update, "refused", reply.text)

    def wait(self) -> None:
        """Waits for the answer that is missing, and notes it."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        self.poll()

    def _send(self, update: UpdateRecord) -> None:
        def call() -> Reply:
            path = self._journal.folder / update.file
            data = read_whole(path, "weights file", MAX_WEIGHTS_BYTES)
            return send_weights(self._session, self._car, data)

        if not self.closed:
            self.unanswered.append((update, self._thread.submit(call)))

    def _note(self, update: UpdateRecord, verdict: Verdict, answer: str) -> None:
        if update.verdict != "rolled back":  # that event may come before the answer
            update.verdict, update.answer = verdict, answer
            self._journal.save()
        self._say(f"{update.version}: {'refused: ' if verdict == 'refused' else ''}{answer}")
