"""What a controller process was told, cycle by cycle, and what it answered, read from a log."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from bayesrace.controller.interface import Environment
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    EVENT,
    STATE,
    TELEMETRY,
    Actuation,
    Event,
    Message,
    State,
    Telemetry,
)
from bayesrace.operation.analysis.recording import RUN_EVENT, PlannedRun

__all__ = ["COMMANDS", "Cycle", "Life", "read_lives"]

COMMANDS: Final = ("stop", "go", "hold_lost")
"""Kinds of the controller's events; the last one is a stop until another run."""

_RESTARTED: Final = 50
"""An event that acts on telemetry so far back is of a controller that has not sent any yet."""
_LOST: Final = "messages before it are not in the log"


@dataclass(frozen=True, eq=False)
class Cycle:
    """One cycle: what came before it, and what it answered."""

    states: tuple[State, ...]
    """Taken since the cycle before, in order; the last one is answered, unless there is none."""
    answered: State
    commands: tuple[str, ...]
    """:data:`COMMANDS` before it."""
    limit_mps: float | None
    """Speed limit of weights that predict worse than others; None: no limit."""
    sent: Actuation
    how: Telemetry
    unknown: str
    """Why the recording does not say all that it depends on; empty: it does."""

    @property
    def run(self) -> tuple[int, int]:
        """The plant's epoch, and the number of its run."""
        return _run(self.sent)

    def limits(self, vx_mps: float, slow_down_mps2: float) -> Environment | None:
        """As :meth:`bayesrace.controller.weights.adoption.Adoption.limits`."""
        if self.limit_mps is None:
            return None
        if vx_mps > self.limit_mps:
            return Environment(vx_mps, slow_down_mps2)
        return Environment(self.limit_mps)


@dataclass(eq=False)
class Life:
    """All cycles of one controller process, in order."""

    controller: str = ""
    """As a race names it; empty: of another recording."""
    cycles: list[Cycle] = field(default_factory=list)

    @property
    def hold(self) -> bool:
        """Whether the controller was waiting for ``go`` at first."""
        return bool(self.cycles) and self.cycles[0].how.status == Status.HALTED

    def runs(self) -> Iterator[list[Cycle]]:
        """Its cycles by run."""
        for _, run in groupby(self.cycles, lambda one: one.run):
            yield list(run)


def _run(message: State | Actuation) -> tuple[int, int]:
    return message.epoch, message.run


def read_lives(path: Path, names: Collection[str]) -> list[Life]:
    """The controller processes of a log, in order; InputError for no log of one car's drive.

    ``names``: those of its cars (:func:`~bayesrace.learning.sources.log_facts`)."""
    if len(names) != 1:
        found = f"of {', '.join(names)}" if names else "of no car"
        raise InputError(f"{path} holds states {found}: give the log of one car's drive")
    lives: list[_Messages] = []
    named: dict[int, str] = {}
    states: list[State] = []
    numbers: dict[type[Message], int] = {Actuation: -1, Telemetry: -1}
    of = dict.fromkeys(numbers, 0)
    events: list[tuple[int, Event]] = []  # with the number of the life
    reader = LogReader(path)
    for entry in reader.messages((STATE, ACTUATION, TELEMETRY, EVENT)):
        message = entry.message
        if isinstance(message, State):
            states.append(message)
        elif isinstance(message, Event):
            number = message.data.get("telemetry_seq")
            of_next = isinstance(number, int) and number < numbers[Telemetry] - _RESTARTED
            events.append((of[Telemetry] + of_next, message))
            if message.kind == RUN_EVENT and (plan := PlannedRun.of_event(message.data)):
                named[plan.run] = plan.controller
        else:
            kind: type[Message] = type(message)
            of[kind] += message.seq <= numbers[kind]
            numbers[kind] = message.seq
            lives += [_Messages() for _ in range(of[kind] + 1 - len(lives))]
            lives[of[kind]].numbered[kind][message.seq] = message
    for number, event in events:
        if event.source == "controller" and number < len(lives):
            lives[number].events.append(event)
    places = {(one.epoch, one.run, one.seq): at for at, one in enumerate(states)}
    made = [one.life(states, places, named) for one in lives]
    if not any(one.cycles for one in made):
        why = f": {reader.last_reason}" if reader.refused else ""
        raise InputError(f"{path} holds no cycle of a controller{why}; give the log of a drive")
    return [one for one in made if one.cycles]


class _Messages:
    """Of one life, as they were found."""

    def __init__(self) -> None:
        self.numbered: dict[type[Message], dict[int, Any]] = defaultdict(dict)
        self.events: list[Event] = []

    def life(
        self,
        states: Sequence[State],
        places: dict[tuple[int, int, int], int],
        named: dict[int, str],
    ) -> Life:
        """Its cycles; ``places``: where in ``states`` each is."""
        life, next_at, before, unknown = Life(), 0, None, ""
        for seq, how in sorted(self.numbered[Telemetry].items()):
            sent: Actuation | None = self.numbered[Actuation].get(seq)
            at = None if sent is None else places.get((*_run(sent), sent.state_seq))
            if sent is None or at is None:  # it cannot be compared either
                continue
            answered = states[at]
            if not life.cycles:
                life.controller = named.get(sent.run, "")
                next_at = next(i for i in range(at + 1) if _run(states[i]) == _run(answered))
            count = how.states if how.states >= 0 else max(at + 1 - next_at, 0)
            taken = states[max(at + 1 - count, 0) : at + 1]
            if before is None or before.run != _run(sent):
                unknown = self._beginning(before, taken, how)
            lost = before is not None and seq != before.how.seq + 1
            if lost or len(taken) < count:
                unknown = unknown or _LOST
            if not answered.lockstep and (how.states < 0 or how.prepared_s < 0):
                unknown = unknown or "recorded by an earlier release, which does not say all of it"
            commands = tuple(self._commands(-1 if before is None else before.how.seq, seq))
            limit_mps = self._limit_mps(how)
            before = Cycle(tuple(taken), answered, commands, limit_mps, sent, how, unknown)
            life.cycles.append(before)
            next_at = max(next_at, at + 1)
        return life

    @staticmethod
    def _beginning(before: Cycle | None, taken: Sequence[State], how: Telemetry) -> str:
        """What is not known from the beginning of a run on; empty: nothing."""
        first = next((one for one in taken if _run(one) == _run(taken[-1])), None)
        if first is None or first.time_s > 0:
            return "the recording begins in the middle of the run"
        if before is None and how.seq > 0 and not first.lockstep and how.delay_s > 0:
            return "the recording does not say how the controller has measured its delay before"
        return ""

    def _commands(self, after: int, seq: int) -> Iterator[str]:
        """Between the cycles with these numbers."""
        for event in self.events:
            number = event.data.get("telemetry_seq")
            if event.kind in COMMANDS and isinstance(number, int) and after < number <= seq:
                yield event.kind

    def _limit_mps(self, how: Telemetry) -> float | None:
        """A limit stays until other weights are sent for, also where the watch goes back."""
        limit_mps: float | None = None
        for event in self.events:
            begins = event.data.get("cycle")
            if not isinstance(begins, int) or begins > how.tick:
                continue
            if event.kind == "weights_slowed":
                limit_mps = float(event.data.get("speed_limit_mps", 0.0))
            elif event.kind == "weights_accepted" or event.data.get("by") == "request":
                limit_mps = None
        return limit_mps
