"""The predictive controller as the process drives it: native step, weights, telemetry."""

from typing import Any, Final

from bayesrace.controller.interface import StepOutput
from bayesrace.controller.native_step import Artefact, NativeStep, StepStatus
from bayesrace.controller.weights.adoption import WeightsPort
from bayesrace.gp.weights import decode_weights
from bayesrace.messages import NOT_REPORTED

__all__ = ["PredictiveController"]

_IN_C: Final = {
    "residual_dynamics": "defect",
    "residual_bounds": "bound",
    "residual_stationarity": "stationarity",
    "n_ref_m": "lateral_m",
}
"""Names in br_mpc_info, where they are not those of :class:`bayesrace.messages.Telemetry`."""


class PredictiveController:
    """See :class:`.Controller`; BestCase, WorstCase and BayesRace alike."""

    def __init__(
        self,
        step: NativeStep,
        weights_version: str = "",
        port: WeightsPort | None = None,
        track: str = "",
    ) -> None:
        """``step``: with parameters and path set. ``weights_version``: of what it holds already.
        ``port``: how a process takes over new ones; without, :meth:`set_weights` does. ``track``:
        identity of the track that the path is for."""
        self.native = step
        self.port = port
        self.track = track
        self._version = weights_version
        known = {name for name, _ in step.artefact.ffi.typeof("br_mpc_info").fields}
        names = ((name, _IN_C.get(name, name)) for name in NOT_REPORTED)
        self._numbers = [(name, in_c) for name, in_c in names if in_c in known]
        self._output = StepOutput(
            u=step.plan_u[0],
            plan_x=step.plan_x,
            plan_u=step.plan_u,
            tube_m=step.tube,
            plan_step_s=step.manifest.step_s,
        )

    last_error = ""
    """The cycle knows it."""

    @property
    def artefact(self) -> Artefact:
        """What it was built as."""
        return self.native.artefact

    @property
    def weights_version(self) -> str:
        """Version of the weights in use; empty while there is no correction."""
        return self._version

    def set_weights(self, data: bytes) -> str:
        """From the next step on; the plan and everything else goes on as it is."""
        weights = decode_weights(data)
        self.native.set_weights(weights)
        self._version = weights.version
        return weights.version

    def adopt_weights(self, version: str) -> None:
        """What is staged is used from the next step on; the plan goes on."""
        self.native.adopt_weights()
        self._version = version

    def revert_weights(self, version: str) -> None:
        """The proven weights, of that version, are used again from the next step on."""
        self.native.revert_weights()
        self._version = version

    def begin_cycle(self, memory: Any, size: int, hold: bool, cycle: Any) -> int:
        """With the compiled step, called from C."""
        native = self.native
        drive = native.artefact.library.br_cycle_drive_mpc
        return int(drive(memory, size, native.handle, hold, cycle))

    def raise_pending(self) -> None:
        """Nothing: its step is C."""

    def result(self, cycle: Any) -> StepOutput:
        """Of the cycle's last step; the plan, too, if it is not usable."""
        info = self.artefact.library.br_cycle_info(cycle)
        output = self._output
        self.native.read_plan()
        self.native.read_tube()
        # Acceptable and converged may both be driven; the residuals below distinguish them.
        output.status = 0 if info.status <= StepStatus.ACCEPTABLE else info.status
        output.cost = info.cost
        output.cost_shifted = info.shifted_cost if info.shifts >= 0 else -1.0
        output.second_start = info.second_start
        output.numbers = {name: getattr(info, in_c) for name, in_c in self._numbers}
        return output
