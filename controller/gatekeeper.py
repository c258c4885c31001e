"""The gatekeeper process: decodes and checks weights, watches those in use, keeps what is accepted.

    python -m controller.gatekeeper SOCKET MEMORY CAPACITY

Started by the controller (:mod:`controller.courier`), with which it shares a socket and a piece of
memory; ends when that one does. Whatever a weights file may do to the process that decodes it, it
does to this one. One request at a time; between an offer and the news that it has been taken, or
not, nothing else is done, so the memory never changes under the controller.
"""

import os
import select
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.gp.weights import decode_weights
from bayesrace.messages import Scalar
from bayesrace.vehicles import described_car
from controller.gate.channel import Channel, Message
from controller.gate.judge import Gate, Incumbent, Verdict, Watch
from controller.gate.memory import ALL_SEEN, Memory, Noted
from controller.gate.samples import Sample, Sampler
from controller.gate.settings import GateSettings
from controller.gate.store import Accepted, Store, digest_of, trimmed

__all__ = ["Gatekeeper", "main"]

_NICE: Final = 5
"""Behind control, transport and plant, who share the CPUs."""

_LOCKSTEP_POLL_S: Final = 5e-5
"""The controller waits for the watch, then."""
_POLL_S: Final = 0.02
_IDLE_POLL_S: Final = 0.05
_IDLE_NS: Final = 1_000_000_000
_REST_S: Final = 1.0
"""Longest wait for a message, between two signs of life, while nothing is watched."""
_SIGNS: Final = 8
"""At least so many signs of life within ``hang_s``, after which it would be replaced."""


class Gatekeeper:
    """Serves one controller until its end of the channel is closed."""

    def __init__(self, channel: Channel, memory: Memory) -> None:
        self._channel, self._memory = channel, memory
        self._backlog: deque[Message] = deque()
        self._read = 0
        self._read_ns = 0
        self._lockstep = False
        self._watch: Watch | None = None
        self._watch_from = 0

    def serve(self) -> None:
        """Until the controller is gone."""
        first = self._channel.receive()
        if first is None:
            return
        self._start(*first)
        self._memory.show_life()
        self._channel.send("ready")
        if self._folder is not None:  # one that died may not have come to it
            self._keep()
        while True:
            self._memory.show_life()
            if self._watch is not None:
                self._look()
            if not self._backlog and not self._arrived(self._patience_s()):
                continue
            message = self._backlog.popleft() if self._backlog else self._channel.receive()
            if message is None:
                return
            fields, data = message
            if fields["kind"] == "check":
                self._check(int(fields["number"]), data)
            elif fields["kind"] == "previous":
                self._previous(int(fields["number"]))

    # Beginning -----------------------------------------------------------------------------------

    def _start(self, fields: dict[str, Any], data: bytes) -> None:
        settings = GateSettings.model_validate(fields["settings"])
        self._rest_s = min(_REST_S, settings.hang_s / _SIGNS)
        car = described_car(fields["car"])
        self._gate = Gate(settings, Path(fields["artefact"]), car)
        self._sampler = Sampler(self._gate.step_s, car.tuning.gate.moving_mps)
        self._recent: deque[Sample] = deque(maxlen=settings.recent_samples)
        self._withdrawn: list[str] = list(fields["withdrawn"])
        self._next_number = int(fields["next_number"])
        self._files: list[Accepted] = []
        self._incumbents: list[Incumbent] = []
        begin = 0
        for number, version, proven, accepted_utc_ns, size in fields["history"]:
            file = data[begin : begin + size]
            self._push(Accepted(number, version, file, proven, accepted_utc_ns))
            begin += size
        self._folder = Path(fields["store"]) if fields["store"] else None
        self._discretisation = str(fields["discretisation"])
        self._store: Store | None = None
        self._update()
        self._watch_in_use(int(fields["watch_from"]))

    def _push(self, accepted: Accepted) -> None:
        weights = decode_weights(accepted.data) if accepted.data else None
        accepted_utc_ns = accepted.accepted_utc_ns or time.time_ns()  # by the start, if by none
        incumbent = Incumbent(
            accepted.number, accepted.version, weights, accepted.proven, accepted_utc_ns
        )
        self._files = trimmed([*self._files, accepted])
        self._incumbents = trimmed([*self._incumbents, incumbent])

    def _pop(self) -> Accepted:
        self._incumbents.pop()
        return self._files.pop()

    @property
    def _reference(self) -> Incumbent | None:
        """The newest weights that have proved good, which the watch goes back to."""
        return next((one for one in reversed(self._incumbents) if one.proven), None)

    def _watch_in_use(self, begin: int) -> None:
        """Watches those in use from state ``begin`` on, unless they have proved good."""
        in_use, reference = self._incumbents[-1], self._reference
        unproven = reference is not None and not in_use.proven
        self._watch = None
        if reference is not None and unproven:
            self._watch = Watch(self._gate, in_use, reference, self._fresh())
        self._watch_from = begin
        self._memory.tell_watched(begin if self._watch else ALL_SEEN, go_back=False)

    # Requests ------------------------------------------------------------------------------------

    def _arrived(self, patience_s: float) -> bool:
        """Waits for a message."""
        readable, _, _ = select.select([self._channel], [], [], patience_s)
        return bool(readable)

    def _patience_s(self) -> float:
        """How long to wait for a message before the watch looks at new states again [s]."""
        if self._watch is None:
            return self._rest_s
        if time.monotonic_ns() - self._read_ns > _IDLE_NS:
            return _IDLE_POLL_S
        return _LOCKSTEP_POLL_S if self._lockstep else _POLL_S

    def _check(self, number: int, data: bytes) -> None:
        """Answers; offers what is good, and waits for what becomes of it."""
        if self._watch is None:  # else it has just looked, and nothing may pass it by
            self._update()
        verdict = self._judged(data)
        if not verdict.accepted:
            self._channel.send("refused", text=verdict.text, data=verdict.data)
            return
        weights = decode_weights(data)
        self._memory.lay(weights)
        self._memory.tell_watched(0, go_back=False)
        self._channel.send("offer", text=verdict.text, data=verdict.data)
        taken = self._outcome()
        if taken is None:
            self._watch_in_use(self._watch_from)
            return
        accepted_utc_ns = int(taken["accepted_utc_ns"])
        self._push(Accepted(number, weights.version, data, False, accepted_utc_ns))
        self._incumbents[-1] = replace(self._incumbents[-1], _model=verdict.model)
        self._next_number = number + 1
        self._watch_in_use(int(taken["noted"]))
        self._keep()

    def _judged(self, data: bytes) -> Verdict:
        if digest_of(data) in self._withdrawn:
            return Verdict(
                False,
                "these weights have been given up before, because they predicted worse than those "
                "before them; train again",
                {},
            )
        try:
            weights = decode_weights(data)
        except InputError as error:
            return Verdict(False, str(error), {})
        against = [self._incumbents[-1]]
        reference = self._reference
        if reference is not None and reference is not against[0]:
            against.append(reference)
        return self._gate.check(weights, against, self._fresh())

    def _fresh(self) -> list[Sample]:
        """Those that are still recent."""
        oldest_ns = time.monotonic_ns() - round(self._gate.settings.recent_s * 1e9)
        return [sample for sample in self._recent if sample.at_ns > oldest_ns]

    def _previous(self, number: int) -> None:
        """Offers the weights before those in use, if these are still the ones that are meant."""
        if len(self._incumbents) < 2 or self._incumbents[-1].number != number:
            self._channel.send("refused", text="the watch has gone back meanwhile", data={})
            return
        before = self._incumbents[-2]
        self._memory.lay(before.weights)
        self._memory.tell_watched(ALL_SEEN if before.proven else 0, go_back=False)
        self._channel.send("offer", text="", data={})
        taken = self._outcome()
        if taken is None:
            self._watch_in_use(self._watch_from)
            return
        self._pop()
        self._watch_in_use(int(taken["noted"]))
        self._keep()

    def _outcome(self) -> dict[str, Any] | None:
        """When the offer was taken: states noted before, and the time; None if it was not."""
        while True:
            self._memory.show_life()
            if not self._arrived(self._rest_s):
                continue
            message = self._channel.receive()
            if message is None:
                sys.exit(0)
            if message[0]["kind"] == "taken":
                return message[0]
            if message[0]["kind"] == "dropped":
                return None
            self._backlog.append(message)

    def _keep(self) -> None:
        """In the store, if there is one; whoever waits for an answer is told if it cannot."""
        why_not = ""
        try:
            if self._folder is not None:
                # Opened as late as this: whoever watches must not die of a disk that is full.
                self._store = self._store or Store(self._folder, self._discretisation)
                self._store.keep(self._files, self._next_number, self._withdrawn)
        except InputError as error:
            why_not = str(error)
        self._channel.send("settled", why_not=why_not)

    # The watch -----------------------------------------------------------------------------------

    def _update(self) -> list[tuple[Noted, Sample | None]]:
        """Reads what has been noted meanwhile, with the samples that it completes."""
        notes, self._read = self._memory.read(self._read)
        if notes:
            self._read_ns, self._lockstep = time.monotonic_ns(), notes[-1].lockstep
        found = [(one, self._sampler.add(one)) for one in notes]
        self._recent += [sample for _, sample in found if sample is not None]
        return found

    def _look(self) -> None:
        """Judges by the newest states, one by one: how they come together is no matter."""
        watch = self._watch
        for noted, sample in self._update():
            if watch is None or noted.number < self._watch_from or watch.over:
                continue
            if watch.count(noted.fallen_back):
                self._give_up(watch, "found no solution in", {})
                return
            comparison = None if sample is None else watch.add(sample)
            if comparison is not None:
                words = f"predicted {' and '.join(comparison.worse)} worse: {comparison.text}"
                self._give_up(watch, words, comparison.data)
                return
        if watch is not None and watch.over:
            self._prove(watch)
        else:
            self._memory.tell_watched(self._read, go_back=False)

    def _prove(self, watch: Watch) -> None:
        watch.new.proven = True
        self._files[-1] = replace(self._files[-1], proven=True)
        self._watch = None
        self._memory.tell_watched(ALL_SEEN, go_back=False)
        self._channel.send("proven", number=watch.new.number)
        self._keep()

    def _give_up(self, watch: Watch, words: str, facts: Mapping[str, Scalar]) -> None:
        """Offers the newest weights that have proved good."""
        data: dict[str, Scalar] = {
            "driven": watch.seen, "cycles": watch.cycles, "fallen_back": watch.fallen_back, **facts
        }  # fmt: skip
        text = words if facts else f"{words} {watch.fallen_back} of {watch.cycles} cycles"
        self._memory.lay(watch.old.weights)
        self._channel.send("give_up", number=watch.old.number, text=text, data=data)
        self._memory.tell_watched(self._read, go_back=True)
        taken = self._outcome()
        if taken is None:  # the controller was busy; the next sample says the same
            self._memory.tell_watched(self._read, go_back=False)
            return
        while self._incumbents[-1].number != watch.old.number:
            self._withdrawn.append(digest_of(self._pop().data))
        self._watch_in_use(int(taken["noted"]))
        self._keep()


def main(arguments: list[str]) -> int:
    """The program; its arguments are the two descriptors and the controller's capacity."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the controller's matter
    os.nice(_NICE)
    end, memory, capacity = map(int, arguments)
    channel = Channel(socket.socket(fileno=end))
    Gatekeeper(channel, Memory(capacity, memory)).serve()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
