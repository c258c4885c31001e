"""The control thread's part in new weights: it adopts them between cycles, watches whether they are
better or worse than the proven ones while the car drives, and goes back.

In real time nothing of that decodes, waits or takes a lock. Nothing releases the interpreter's lock
or wakes another thread either: that would cost a hundred times the adoption.
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol

from bayesrace.arrays import Floats
from bayesrace.controller.interface import Environment
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.checks import Samples, compare, slack_of
from bayesrace.controller.weights.store import History, Store
from bayesrace.errors import InputError
from bayesrace.messages import Scalar
from bayesrace.vehicles import Car

__all__ = [
    "RULINGS", "Adopter", "Adoption", "AgainError", "Ruling", "StepPort", "Task", "Watch",
    "WeightsPort", "ruling_of",
]  # fmt: skip

Action = Literal["back", "slow", "proven"]

RULINGS: Final[tuple[Action, ...]] = ("proven", "slow", "back", "back")
"""What each br_mpc_ruling (controller/native/bayesrace_mpc.h) from 1 on asks for."""
_HOPELESS: Final = len(RULINGS)

_TASK_S: Final = 2.0
"""The control loop, driving or idle, does a task within a cycle or a heartbeat; this is a stall."""
_POLL_S: Final = 0.02
"""Between two looks at what is waited for: the control thread wakes no other thread."""


class AgainError(InputError):
    """A refusal whose reason passes: the same request may be accepted later."""


@dataclass
class WeightsPort:
    """What the weights of a predictive controller are checked by and kept in."""

    artefact: Path
    car: Car
    history: History
    store: Store | None


@dataclass
class StepPort(WeightsPort):
    """Of a controller in this process."""

    step: NativeStep


@dataclass(eq=False)
class Task:
    """What the control thread is to do between two cycles; it fills in the result."""

    work: Callable[[], Any]
    reverted: int
    """:attr:`Adoption.reverted` when it was asked for: the watch has not gone back since."""
    result: Any = None
    error: str = ""
    """Why it could not be done; else empty."""


class Ruling(NamedTuple):
    """What the watch has found."""

    action: Action
    """Back to the proven weights; slow down, as those predict other outputs worse; or stay: the
    watch is over."""
    text: str
    data: dict[str, Scalar]
    limit_mps: float = 0.0
    """To which the car is to slow down."""


class Adopter(Protocol):
    """What puts weights into use, in this process or elsewhere, and watches them."""

    ruled: Callable[[int, Ruling], None]
    """Called by :meth:`follow` and all that waits, with a ruling and the cycle it is before."""
    reverted: int
    """Rulings by which the watch has gone back."""
    slow: Environment | None
    us: float
    longest_us: float
    restarted: bool
    """The history may not be what drives."""

    @property
    def unknown_s(self) -> float:
        """As :attr:`.NativeStep.unknown_s`, after an adoption."""

    def follow(self) -> object:
        """Hands the watch's rulings on."""

    def samples(self, reverted: int) -> Samples:
        """The newest that the car has shown. AgainError if the watch has gone back more often than
        ``reverted``, or if there is no answer in time."""

    def adopt(self, packed: bytes, version: str, watched: bool, reverted: int) -> int:
        """Puts weights into use, which count as proven if they are not ``watched``: their first
        cycle. Errors as of :meth:`samples`."""


class Watch:
    """Looks between two cycles at what the compiled controller has found; see br_mpc_judge_trial.

    The car goes back only to weights that predict no output worse over the same samples. After a
    demand to slow down the watch goes on, on samples from then on, until other weights are in use:
    the probation does not end.
    """

    def __init__(self, settings: GateSettings, car: Car, step: NativeStep) -> None:
        step_s = step.manifest.step_s
        self._settings, self._slack = settings, slack_of(car, step_s)
        self._step, self.trial = step, step.new_trial(settings.probation(car, step_s))

    def observe(self, vx_mps: float, fallen_back: bool | None) -> None:
        """A state, and whether the fallback drove the cycle before; None: the car was not."""
        self._step.observe_trial(self.trial, vx_mps, fallen_back)

    def look(self) -> Ruling | None:
        """What is to be done, if anything."""
        number = self._step.judge_trial(self.trial)
        return ruling_of(number, self.trial, self._settings, self._slack) if number else None


def ruling_of(number: int, trial: Any, settings: GateSettings, slack: Floats) -> Ruling:
    """A br_mpc_ruling in words; ``trial`` has the members of br_mpc_trial that led to it."""
    found, action = trial.found, RULINGS[number - 1]
    if action == "proven":
        return Ruling(action, "", {})
    data: dict[str, Scalar] = {
        "driven": round(found.fresh), "cycles": trial.cycles,
        "fallen_back": trial.fallen_back, "fastest_mps": trial.fastest_mps,
    }  # fmt: skip
    if number == _HOPELESS:
        text = f"found no solution in {trial.fallen_back} of {trial.cycles} cycles"
        return Ruling(action, text, data)
    new, proven, nominal = list(found.in_use), list(found.proven), list(found.nominal)
    one = compare(settings, slack, found.samples, new, proven, nominal)
    text = f"predicted {one.worse} worse"
    if action == "slow":
        others = compare(settings, slack, found.samples, proven, new, nominal).worse
        text += f", and the proven ones {others}"
    return Ruling(action, f"{text}: {one.text}", data | one.data, trial.limit_mps)


class Adoption:
    """Of this process. Holds one task at most: the update manager sets it, the control thread does
    it."""

    restarted = False

    def __init__(self, port: StepPort, settings: GateSettings) -> None:
        self._step, self._car, self._settings = port.step, port.car, settings
        self._watch = None if port.history.in_use.proven else self._new_watch()
        self.tasks: deque[Task] = deque(maxlen=1)
        """The manager appends, and pops what the control thread does not take."""
        self.done: deque[tuple[int, Task | Ruling]] = deque()
        """Tasks done, and what the watch has found and the control thread has done, in order, each
        with the next cycle's number; the manager takes them."""
        self.ruled: Callable[[int, Ruling], None] = lambda cycle, ruling: None
        self.reverted = 0
        self.slow: Environment | None = None
        """Largest speed with the weights in use, and how fast to slow down to it. None: no
        limit."""
        self.us = self.longest_us = 0.0
        """Duration of the newest adoption, and of the longest."""

    # For the update manager ----------------------------------------------------------------------

    @property
    def unknown_s(self) -> float:
        """See :class:`Adopter`."""
        return self._step.unknown_s

    def samples(self, reverted: int) -> Samples:
        """See :class:`Adopter`."""
        return Samples(*self._ask(self._step.samples, reverted)[1])

    def adopt(self, packed: bytes, version: str, watched: bool, reverted: int) -> int:
        """See :class:`Adopter`."""
        self._step.stage_weights(packed)
        return self._ask(partial(self.use, version, watched), reverted)[0]

    def follow(self) -> int | None:
        """Hands rulings on up to the task that is done, if one is: its cycle. Later rulings are
        about weights that the history does not hold yet."""
        while self.done:
            cycle, what = self.done.popleft()
            if isinstance(what, Task):
                return cycle
            self.ruled(cycle, what)
        return None

    def _ask(self, work: Callable[[], Any], reverted: int) -> tuple[int, Any]:
        """Has the control thread do something: the number of the next cycle, and the result."""
        task, until_s = Task(work, reverted), time.monotonic() + _TASK_S
        self.tasks.append(task)
        while (cycle := self.follow()) is None:
            if time.monotonic() > until_s:
                with suppress(IndexError):  # else the control thread is just doing it
                    self.tasks.pop()
                    why_not = f"the control loop did not take them over within {_TASK_S:g} s"
                    raise AgainError(why_not)
            time.sleep(_POLL_S)
        if task.error:
            raise AgainError(task.error)
        return cycle, task.result

    # For the control thread ----------------------------------------------------------------------

    def _new_watch(self) -> Watch:
        return Watch(self._settings, self._car, self._step)

    def observe(self, vx_mps: float, fallen_back: bool | None) -> None:
        """A state; ``fallen_back``: see :meth:`Watch.observe`."""
        if self._watch is not None:
            self._watch.observe(vx_mps, fallen_back)

    def limits(self, vx_mps: float) -> Environment | None:
        """What limits the car in the next cycle: a faster one slows down from its own speed."""
        slow = self.slow
        if slow is None:
            return None
        if vx_mps > slow.speed_limit_mps:
            return slow._replace(speed_limit_mps=vx_mps)
        return slow._replace(speed_limit_rate_mps2=0.0)

    def between_cycles(self, cycle: int) -> None:
        """Acts on what the watch finds, then on the task; ``cycle``: number of the next."""
        if self._watch is not None and (ruling := self._watch.look()) is not None:
            self._rule(ruling)
            self.done.append((cycle, ruling))
        if self.tasks:
            self._do(cycle)

    def _do(self, cycle: int) -> None:
        try:
            task = self.tasks.popleft()
        except IndexError:  # withdrawn at this moment
            return
        try:
            if task.reverted != self.reverted:
                raise InputError("the watch has rolled back meanwhile; send them again")
            task.result = task.work()
        except InputError as error:
            task.error = str(error)
        self.done.append((cycle, task))

    def use(self, version: str, watched: bool) -> None:
        """Uses staged weights; not ``watched``, they count as proven."""
        begin_ns = time.perf_counter_ns()
        self._step.adopt_weights(version)
        if not watched:
            self._step.prove_weights()
        self._watch, self.slow = self._new_watch() if watched else None, None
        self.us = (time.perf_counter_ns() - begin_ns) * 1e-3
        self.longest_us = max(self.longest_us, self.us)

    def _rule(self, ruling: Ruling) -> None:
        if ruling.action == "slow":
            self.slow = Environment(ruling.limit_mps, self._car.tuning.driving.stop_mps2)
            return
        self._watch = None
        if ruling.action == "proven":
            self._step.prove_weights()
        else:
            self.reverted += 1
            self._step.revert_weights()
