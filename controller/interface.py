"""What the control cycle drives: the compiled controller, or a control law written in Python."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from bayesrace.arrays import Floats

if TYPE_CHECKING:
    from bayesrace.controller.native_step import Artefact, NativeProblem
    from bayesrace.controller.weights.adoption import StepPort

__all__ = ["NO_LIMITS", "NO_PLAN", "ControlLaw", "Controller", "Environment", "StepOutput"]


NO_PLAN: Final[Floats] = np.zeros((0, 2))
"""``plan_u`` of a controller that does not look ahead."""

_NO_TUBE: Final[Floats] = np.zeros(0)
_NO_STATES: Final[Floats] = np.zeros((0, 7))


class Environment(NamedTuple):
    """What limits the car besides: br_environment in controller/native/bayesrace_mpc.h."""

    speed_limit_mps: float = math.inf
    speed_limit_rate_mps2: float = 0.0


NO_LIMITS: Final = Environment()


@dataclass(slots=True)
class StepOutput:
    """Result of one step. A controller may hand out the same object each time, with new values;
    the process has used it up before the next step."""

    u: Floats
    """Shape (2,): d [-], delta_rate [rad/s]. Looked at only if ``status`` is 0."""
    status: int = 0
    """0: usable. Else the controller's own code (1 to 250): the fallback takes over."""
    plan_x: Floats = field(default_factory=lambda: _NO_STATES)
    """Shape (N + 1, 7) or (0, 7): predicted states."""
    plan_u: Floats = field(default_factory=lambda: NO_PLAN)
    """Shape (N, 2) or (0, 2): planned inputs, the first of which is ``u``; the fallback drives on
    along the first ones, as many as the artefact's horizon has."""
    plan_step_s: float = 0.02
    """Time from one row of the plan to the next."""
    cost: float = -1.0
    cost_shifted: float = -1.0
    second_start: int = 0
    """As in :class:`bayesrace.messages.Telemetry`; -1 if there is none."""
    tube_m: Floats = field(default_factory=lambda: _NO_TUBE)
    """Shape (N,) or (0,): as in :class:`bayesrace.messages.Telemetry`."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Further fields of :class:`bayesrace.messages.Telemetry`; those left out are not known."""


class Controller(Protocol):
    """One car's controller, as the process and the driver know it; for one thread."""

    @property
    def artefact(self) -> "Artefact":
        """Whose control cycle it is driven by."""

    def begin_cycle(self, memory: Any, size: int, hold: bool, cycle: Any) -> int:
        """Makes the br_cycle that drives it in that memory; returns a br_mpc_error."""

    def result(self, cycle: Any) -> StepOutput:
        """Of the last step of that cycle; valid until the next."""

    def raise_pending(self) -> None:
        """Raises what C could not: what ends the program, such as KeyboardInterrupt."""

    @property
    def last_error(self) -> str:
        """Of the last step that was broken; empty if none was."""

    @property
    def weights_version(self) -> str:
        """Version of the residual's weights in use; empty if it takes none."""

    @property
    def track(self) -> str:
        """Identity of the track that it drives, as in :class:`bayesrace.messages.Status`."""

    @property
    def nominal(self) -> "NativeProblem | None":
        """The model that states are estimated by where the compiled step drives nothing; None: that
        of the step, with its correction and its variance."""

    @property
    def port(self) -> "StepPort | None":
        """Where a process stages weights that are checked; None: it takes no weights."""


class ControlLaw(Protocol):
    """A controller written in Python, for
    :class:`bayesrace.controller.python_controller.PythonController`.

    None of its methods may block or do input/output. What a method raises ends in the fallback.
    """

    def reset(self) -> None:
        """Forget everything about the past: the next state is the first of a run or a drive."""

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment,
        elapsed_s: float,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """The input for state ``x`` (7,), where ``u_previous`` (2,) acted until now.

        Both arrays change with the next state. ``elapsed_s``: time between the state of the step
        before and this one (0 for the first). ``budget_s``: how long it may take, best effort; 0
        is as long as its settings say.
        """

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """State (7,) after ``duration_s`` (at most 1 s) with input ``u`` (2,) held."""
