"""The predictive controller as the process drives it: native step, weights, telemetry."""

import time

from bayesrace.gp.weights import decode_weights
from bayesrace.messages import State
from controller.interface import Array, StepOutput
from controller.native_step import NativeStep
from controller.takeover import WeightsPort

__all__ = ["PredictiveController"]


class PredictiveController:
    """See :class:`controller.interface.Controller`; BestCase, WorstCase and BayesRace alike."""

    def __init__(
        self, step: NativeStep, weights_version: str = "", port: WeightsPort | None = None
    ) -> None:
        """``step``: with parameters and path set. ``weights_version``: of what it holds already.
        ``port``: how a process takes over new ones; without, :meth:`set_weights` does."""
        self.native = step
        self.port = port
        self._version = weights_version
        self._output = StepOutput(
            u=step.u,
            plan_x=step.plan_x,
            plan_u=step.plan_u,
            plan_step_s=step.manifest.step_s,
        )

    @property
    def weights_version(self) -> str:
        """Version of the weights in use; empty while there is no correction."""
        return self._version

    def reset(self, state: State) -> None:
        """Next step starts cold."""
        self.native.reset()

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

    def prepare(self, elapsed_s: float, budget_s: float = 0.0) -> None:
        """Iterates on until converged if there is a budget, then shifts and condenses."""
        self.native.prepare(elapsed_s, budget_s)

    def rehearse(self) -> None:
        """The preparation once more."""
        self.native.rehearse()

    def predict(self, x: Array, u: Array, duration_s: float) -> Array:
        """By the model the OCP predicts with, corrected by the weights in use."""
        return self.native.predict(x, u, duration_s)

    def limit_speed(self, limit_mps: float, rate_mps2: float) -> None:
        """The reference point moves along the line no faster."""
        self.native.set_speed_limit(limit_mps, rate_mps2)

    def step(
        self, x: Array, u_previous: Array, elapsed_s: float, budget_s: float = 0.0
    ) -> StepOutput:
        """One native step, timed around the C call."""
        native, output = self.native, self._output
        begin_ns = time.perf_counter_ns()
        status = native.step(x, u_previous, elapsed_s=elapsed_s, budget_s=budget_s)
        output.solve_us = (time.perf_counter_ns() - begin_ns) * 1e-3
        native.read_plan()
        info = native.info
        # Acceptable and converged may both be driven; the residuals below tell them apart.
        output.status = 0 if status.usable else int(status)
        output.iterations = info.iterations
        output.residual_dynamics = info.defect
        output.residual_bounds = max(info.bound, 0.0)
        output.residual_stationarity = info.stationarity
        output.cost = info.cost
        output.cost_shifted = info.shifted_cost if info.shifts >= 0 else -1.0
        output.second_start = info.second_start
        output.s_ref_m = info.s_ref_m
        output.n_ref_m = info.lateral_m
        return output
