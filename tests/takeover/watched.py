"""A drive in one process whose weights are checked and watched, as a controller process does it."""

import math

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.interface import Environment
from bayesrace.controller.mpc import PredictiveController
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.weights.adoption import Ruling, Watch, limits_at, slowed_down
from bayesrace.controller.weights.checks import Checks
from bayesrace.controller.weights.settings import GateSettings
from bayesrace.gp.weights import GpWeights, encode_weights, pack_weights, zero_weights
from bayesrace.messages import State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.raceline import racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles import CarParameters

__all__ = ["Course"]


class WatchedLoop(ClosedLoop):
    """A closed loop in which weights are watched: the watch rules between two cycles."""

    def watch(self, step: NativeStep) -> None:
        """In the next run, over the weights that ``step`` has adopted."""
        self._step, self._gate = step, GateSettings()
        self._watch: Watch | None = Watch(self._gate, self._car, step.manifest.step_s)
        self._slow: Environment | None = None
        self.found: list[str] = []
        """What the watch has done, and when."""

    def _limits(self, state: State) -> Environment | None:
        if self._watch is not None:
            self._watch.observe(state.x[3], self._cycle.driver.fallen_back)
            ruling = self._watch.look(self._step.watch())
            if ruling is not None:
                self._rule(ruling, state)
        return None if self._slow is None else limits_at(state.x[3], self._slow)

    def _rule(self, ruling: Ruling, state: State) -> None:
        if ruling.action == "proven":
            self._watch = None
            return
        self.found.append(f"{ruling.action} at {len(self._states)}, {state.x[3]:.1f} m/s")
        if ruling.action == "slow":
            fastest_mps = float(ruling.data["fastest_mps"])
            self._slow = slowed_down(self._gate, self._car, fastest_mps)
        else:
            self._watch = None
            self._step.revert_weights()


class Course:
    """A car on a track, and the checks of its controller."""

    def __init__(self, car: CarParameters, track: str, seconds: float) -> None:
        self._car, self._seconds = car, seconds
        self._track = load_track(track, car.width_m)
        self._line = racing_line(self._track, car)
        self._artefact = build(BuildSettings(car=car))[0]
        self._checks = Checks(GateSettings(), self._artefact, car)

    def drive(self, weights: GpWeights, proven: GpWeights | None) -> tuple[str, float]:
        """What became of the weights, and the largest excess over the edge [m]."""
        if not self._checks.judge(encode_weights(weights)).packed:
            return "refused as absurd", -math.inf
        before = proven or zero_weights(weights.car, weights.discretisation)
        controller, packed = self._controller(before), pack_weights(weights)
        controller.native.stage_weights(packed)
        controller.native.adopt_weights()
        loop = WatchedLoop(self._car, self._track, self._line, controller)
        loop.watch(controller.native)
        run = loop.drive(0, self._seconds)
        return "; ".join(loop.found) or "kept", float(run.off_track_m.max())

    def _controller(self, weights: GpWeights) -> PredictiveController:
        return compiled_controller(self._artefact, self._car, self._track, self._line, weights)
