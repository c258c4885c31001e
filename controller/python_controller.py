"""A control law written in Python, driven by the control cycle in C as the compiled one is.

For comparisons, data collection and tests: it has the same fallback, delay compensation
and stop. Each call costs some microseconds for the way from C into Python.
"""

import ctypes as ct
from pathlib import Path
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from controller.driver import DOUBTED, STEP_FAILED
from controller.interface import ControlLaw, Environment, StepOutput
from controller.native_library import Artefact

__all__ = ["PythonController"]

_DOUBLES: Final = ct.POINTER(ct.c_double)
_STEP = ct.CFUNCTYPE(
    ct.c_int, ct.c_void_p, _DOUBLES, _DOUBLES, _DOUBLES, ct.c_double, ct.c_double, ct.c_void_p
)
_PREPARE = ct.CFUNCTYPE(None, ct.c_void_p, ct.c_double, ct.c_double)
_REHEARSE = _RESET = ct.CFUNCTYPE(None, ct.c_void_p)
_PREDICT = ct.CFUNCTYPE(ct.c_int, ct.c_void_p, _DOUBLES, _DOUBLES, ct.c_double, _DOUBLES)


class _Functions(ct.Structure):
    """br_controller in controller/native/bayesrace_cycle.h."""

    _fields_ = [
        ("self", ct.c_void_p),
        ("step", _STEP),
        ("prepare", _PREPARE),
        ("rehearse", _REHEARSE),
        ("predict", _PREDICT),
        ("reset", _RESET),
        ("steer", ct.c_void_p),
    ]


class PythonController:
    """See :class:`controller.interface.Controller`."""

    port = None
    """It has nowhere to put weights."""
    weights_version = ""
    track = ""
    """Its law knows."""

    def __init__(self, artefact: Path, law: ControlLaw) -> None:
        """``artefact``: any built for a car; its control cycle is used, its step is not."""
        self.artefact = Artefact(artefact)
        self.law = law
        self.last_error = ""
        self._pending: BaseException | None = None
        self._was_reset = True
        self._result = StepOutput(u=np.zeros(2))
        self._functions = _Functions(
            None,
            _STEP(self._step),
            _PREPARE(lambda *_: None),
            _REHEARSE(lambda _: None),
            _PREDICT(self._predict),
            _RESET(self._reset),
            None,  # braking, its steering is held
        )

    def begin_cycle(self, memory: ct.c_void_p, size: int, hold: bool, cycle: ct.c_void_p) -> int:
        """With this object's functions."""
        init = self.artefact.library.br_cycle_init
        return int(init(memory, size, ct.byref(self._functions), hold, ct.byref(cycle)))

    def result(self, cycle: ct.c_void_p) -> StepOutput:
        """What the law returned."""
        return self._result

    def raise_pending(self) -> None:
        """An interrupt while the law was at work."""
        pending, self._pending = self._pending, None
        if pending is not None:
            raise pending

    def adopt_weights(self, version: str) -> None:
        """Never asked."""
        raise InputError("a control law in Python takes no weights")

    def revert_weights(self, version: str) -> None:
        """Never asked."""
        raise InputError("a control law in Python takes no weights")

    def set_weights(self, data: bytes) -> str:
        """Always refused."""
        raise InputError("a control law in Python takes no weights")

    def _caught(self, error: BaseException) -> None:
        """C knows no exceptions: what is raised is kept, and the cycle falls back."""
        self.last_error = f"{type(error).__name__}: {error}"
        if not isinstance(error, Exception):
            self._pending = error

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
        solution: int,
    ) -> int:
        if not self._was_reset:
            return STEP_FAILED
        try:
            around = Environment(environment[0], environment[1])
            output = self.law.step(_array(x, 7), _array(u_before, 2), around, elapsed_s, budget_s)
            self._fill(self.artefact.Solution.from_address(solution), output)
            if not 0 <= output.status < DOUBTED:
                raise ValueError(f"status {output.status} is not from 0 to {DOUBTED - 1}")
        except BaseException as error:
            self._caught(error)
            return STEP_FAILED
        self._result = output
        return output.status

    def _fill(self, solution: Any, output: StepOutput) -> None:
        rows = min(len(output.plan_u), self.artefact.manifest.horizon)
        solution.u[:] = output.u.tolist()
        solution.rows = rows
        solution.plan_u[: 2 * rows] = output.plan_u[:rows].ravel().tolist()
        solution.plan_step_s = output.plan_step_s
        solution.second_start = output.second_start
        solution.cost, solution.shifted_cost = output.cost, output.cost_shifted

    def _predict(self, _: Any, x: Any, u: Any, duration_s: float, x_next: Any) -> int:
        try:
            after = self.law.predict(_array(x, 7), _array(u, 2), duration_s)
            np.ctypeslib.as_array(x_next, (7,))[:] = after
        except BaseException as error:
            self._caught(error)
            return -1
        return 0


def _array(pointer: Any, count: int) -> Floats:
    """A copy."""
    return np.array(pointer[:count])
