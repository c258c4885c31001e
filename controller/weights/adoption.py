"""The control thread's part in new weights: it adopts them between cycles, watches whether they are
better or worse than the proven ones while the car drives, and goes back.

In real time nothing here decodes, waits or takes a lock. Nothing releases the interpreter's lock or
wakes another thread either: that would cost a hundred times the adoption.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from bayesrace.controller.interface import Environment
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import WATCHED, GateSettings
from bayesrace.controller.weights.checks import compare, slack_of
from bayesrace.controller.weights.store import History, Store
from bayesrace.errors import InputError
from bayesrace.messages import Scalar
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["Adoption", "Ruling", "Task", "Watch", "WeightsPort"]

_BEND: Final = 5.0
"""Wheelbases: radius of the bend that a car still takes at its limit where it is slowed down."""

_HOPELESS: Final = 0.8
"""Share of cycles without a solution from which on no car can drive."""


@dataclass
class WeightsPort:
    """What a predictive controller and its weights need of each other."""

    artefact: Path
    step: NativeStep
    car: Car
    history: History
    store: Store | None = None


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

    action: Literal["back", "slow", "proven"]
    """Back to the proven weights; slow down, as those predict other outputs worse; or stay: the
    watch is over."""
    text: str
    data: dict[str, Scalar]


class Watch:
    """Looks between two cycles at what the compiled controller has found; see br_mpc_get_watch."""

    def __init__(self, settings: GateSettings, car: Car, step_s: float) -> None:
        self._settings, self.resolution = settings, slack_of(car, step_s)
        self._needed = settings.watch_s / step_s
        self._driven = self._judged = 0.0
        self._cycles = self._fallen_back = 0
        self._fastest_mps, self._slowed_after = 0.0, -1.0

    @property
    def data(self) -> dict[str, Scalar]:
        """Counts since the adoption: samples, cycles, and those without a solution."""
        return {
            "driven": round(self._driven), "cycles": self._cycles,
            "fallen_back": self._fallen_back, "fastest_mps": self._fastest_mps,
        }  # fmt: skip

    def observe(self, vx_mps: float, fallen_back: bool | None) -> None:
        """A state, and whether the fallback drove the cycle before; None: the car was not."""
        self._fastest_mps = max(self._fastest_mps, vx_mps)
        if fallen_back is not None:
            self._cycles += 1
            self._fallen_back += fallen_back

    def look(self, found: Any) -> Ruling | None:
        """What is to be done, if anything, by the compiled controller's report.

        The car goes back only to weights that predict no output worse over the same samples. After
        a demand to slow down the watch goes on, on samples from then on, until other weights are in
        use: the probation does not end.
        """
        settings = self._settings
        if self._cycles >= settings.watch_cycles and self._fallen_back > _HOPELESS * self._cycles:
            text = f"found no solution in {self._fallen_back} of {self._cycles} cycles"
            return Ruling("back", text, self.data)
        slowed = self._slowed_after >= 0
        judged = found.fresh + found.samples  # rises with each sample that is judged
        if judged == self._judged or found.samples < settings.watch_least:
            return None
        self._driven, self._judged = found.fresh, judged
        if slowed and self._driven - self._slowed_after < WATCHED:
            return None
        errors = list(found.in_use), list(found.proven), list(found.nominal)
        new, proven, nominal = errors
        one = compare(settings, self.resolution, found.samples, new, proven, nominal)
        if not one.worse:
            done = self._driven >= self._needed and not slowed
            return Ruling("proven", "", {}) if done else None
        data = self.data | one.data
        others = compare(settings, self.resolution, found.samples, proven, new, nominal).worse
        if not others:
            return Ruling("back", f"predicted {one.worse} worse: {one.text}", data)
        if slowed:
            return None
        self._slowed_after = self._driven
        text = f"predicted {one.worse} worse, and the proven ones {others}: {one.text}"
        return Ruling("slow", text, data)


class Adoption:
    """Holds one task at most: the update manager sets it, the control thread does it."""

    def __init__(self, port: WeightsPort, settings: GateSettings) -> None:
        self._step, self._car, self._settings = port.step, port.car, settings
        self._watch = None if port.history.in_use.proven else self._new_watch()
        self.tasks: deque[Task] = deque(maxlen=1)
        """The manager appends, and pops what the control thread does not take."""
        self.done: deque[tuple[int, Task | Ruling]] = deque()
        """Tasks done, and what the watch has found and the control thread has done, in order, each
        with the next cycle's number; the manager takes them."""
        self.reverted = 0
        """Rulings by which the watch has gone back."""
        self.slow: Environment | None = None
        """Largest speed with the weights in use, and how fast to slow down to it. None: no
        limit."""
        self.us = self.longest_us = 0.0
        """Duration of the newest adoption, and of the longest."""

    def _new_watch(self) -> Watch:
        return Watch(self._settings, self._car, self._step.manifest.step_s)

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
        if self._watch is not None:
            ruling = self._watch.look(self._step.watch(self._watch.resolution))
            if ruling is not None:
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

    def adopt(self, version: str, watched: bool) -> None:
        """Uses staged weights; not ``watched``, they count as proven. For the control thread."""
        begin_ns = time.perf_counter_ns()
        self._step.adopt_weights(version)
        if not watched:
            self._step.prove_weights()
        self._watch, self.slow = self._new_watch() if watched else None, None
        self.us = (time.perf_counter_ns() - begin_ns) * 1e-3
        self.longest_us = max(self.longest_us, self.us)

    def _rule(self, ruling: Ruling) -> None:
        if ruling.action == "slow":
            self.slow = self._slowed_down(float(ruling.data["fastest_mps"]))
            return
        self._watch = None
        if ruling.action == "proven":
            self._step.prove_weights()
        else:
            self.reverted += 1
            self._step.revert_weights()

    def _slowed_down(self, fastest_mps: float) -> Environment:
        """The limit of a car that has driven so fast with weights that are worse for it."""
        bend_m = _BEND * self._car.wheelbase_m
        least_mps = math.sqrt(self._car.friction * GRAVITY_MPS2 * bend_m)
        limit_mps = max(self._settings.slow_share * fastest_mps, least_mps)
        return Environment(limit_mps, self._car.tuning.driving.stop_mps2)
