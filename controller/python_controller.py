"""A control law written in Python, driven by the control cycle in C as the compiled one is.

For comparisons, data collection and tests: it has the same fallback, delay compensation
and stop. Each call costs some microseconds for the way from C into Python.
"""

from pathlib import Path
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.interface import ControlLaw, Environment, StepOutput
from bayesrace.controller.native_step import NativeProblem, Status

__all__ = ["PythonController"]


class PythonController:
    """See :class:`bayesrace.controller.interface.Controller`."""

    port = None
    """It has nowhere to put weights."""
    weights_version = ""

    def __init__(self, artefact: Path, law: ControlLaw, track: str = "") -> None:
        """``artefact``: any built for a car; its control cycle is used, its step is not.
        ``track``: identity of the one that the law drives; empty: the status does not say it."""
        self.track = track
        self.nominal = NativeProblem(artefact)
        self.artefact = self.nominal.artefact
        self.law = law
        self.last_error = ""
        self._pending: BaseException | None = None
        self._was_reset = True
        self._result = StepOutput(u=np.zeros(2))
        ffi = self.artefact.ffi
        types = dict(ffi.typeof("br_controller").fields)
        functions: dict[str, Any] = {
            "step": self._step,
            "prepare": lambda *_: None,
            "rehearse": lambda _: None,
            "predict": self._predict,
            "reset": self._reset,
        }  # without "steer": braking, its steering is held
        # An interrupt may strike before a function's own handler; the call fails then, too.
        failed = {"step": Status.STEP_FAILED, "predict": -1}
        self._functions = {
            name: ffi.callback(types[name].type, function, failed.get(name), self._struck)
            for name, function in functions.items()
        }

    def begin_cycle(self, memory: Any, size: int, hold: bool, cycle: Any) -> int:
        """With this object's functions."""
        controller = self.artefact.ffi.new("br_controller *", self._functions)
        return int(self.artefact.library.br_cycle_init(memory, size, controller, hold, cycle))

    def result(self, cycle: Any) -> StepOutput:
        """What the law returned."""
        return self._result

    def raise_pending(self) -> None:
        """An interrupt while the law was at work."""
        pending, self._pending = self._pending, None
        if pending is not None:
            raise pending

    def _caught(self, error: BaseException) -> None:
        """C knows no exceptions: what is raised is kept, and the cycle falls back."""
        self.last_error = f"{type(error).__name__}: {error}"
        if not isinstance(error, Exception):
            self._pending = error

    def _struck(self, _kind: Any, error: BaseException, _traceback: Any) -> None:
        self._was_reset = False  # it may have been the reset
        self._caught(error)

    def _reset(self, _: Any) -> None:
        self._was_reset = False
        try:
            self.law.reset()
        except BaseException as error:
            self._caught(error)
        else:
            self._was_reset = True

    def _step(
        self,
        _: Any,
        x: Any,
        u_before: Any,
        environment: Any,
        elapsed_s: float,
        budget_s: float,
        solution: Any,
    ) -> int:
        if not self._was_reset:
            return Status.STEP_FAILED
        try:
            around = Environment(*(getattr(environment, name) for name in Environment._fields))
            given = self._array(x, 7), self._array(u_before, 2)
            output = self.law.step(*given, around, elapsed_s, budget_s)
            self._fill(solution, output)
            if not 0 <= output.status < Status.DOUBTED:
                raise ValueError(f"status {output.status} is not from 0 to {Status.DOUBTED - 1}")
        except BaseException as error:
            self._caught(error)
            return Status.STEP_FAILED
        self._result = output
        return output.status

    def _fill(self, solution: Any, output: StepOutput) -> None:
        rows = min(len(output.plan_u), self.artefact.manifest.horizon)
        solution.u[0:2] = output.u.tolist()
        solution.rows = rows
        solution.plan_u[0 : 2 * rows] = output.plan_u[:rows].ravel().tolist()
        solution.plan_step_s = output.plan_step_s
        solution.second_start = output.second_start
        solution.cost, solution.shifted_cost = output.cost, output.cost_shifted

    def _predict(self, _: Any, x: Any, u: Any, duration_s: float, x_next: Any) -> int:
        try:
            after = self.law.predict(self._array(x, 7), self._array(u, 2), duration_s)
            x_next[0:7] = after.tolist()
        except BaseException as error:
            self._caught(error)
            return -1
        return 0

    def _array(self, pointer: Any, count: int) -> Floats:
        """A copy."""
        return np.array(self.artefact.ffi.unpack(pointer, count))
