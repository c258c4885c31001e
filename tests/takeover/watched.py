"""A drive in one process whose weights are checked and watched, as a controller process does it."""

import math
from types import SimpleNamespace
from typing import Any

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.interface import Environment
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import Adoption, Ruling
from bayesrace.controller.weights.checks import Checks
from bayesrace.gp.weights import Weights, encode_weights, pack_weights, zero_weights
from bayesrace.messages import State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.raceline import racing_line
from bayesrace.sensors import EXACT, Sensors
from bayesrace.tracks import load_track
from bayesrace.vehicles import Car

__all__ = ["Course"]


class WatchedLoop(ClosedLoop):
    """A closed loop in which weights are watched: the watch rules between two cycles."""

    adoption: Adoption

    def _limits(self, state: State) -> Environment | None:
        driver = self._cycle.driver
        self.adoption.observe(driver.vx_mps, driver.fallen_back)
        self.adoption.between_cycles(len(self._states))
        return self.adoption.limits(driver.vx_mps)


class Course:
    """A car on a track, and the checks of its controller."""

    def __init__(self, car: Car, track: str, seconds: float, sensors: Sensors = EXACT) -> None:
        self._car, self._seconds, self._sensors = car, seconds, sensors
        self._track = load_track(track, car.width_m)
        self._line = racing_line(self._track, car)
        self._artefact = build(BuildSettings(car=car))[0]
        self._checks = Checks(GateSettings(), self._artefact, car)

    def drive(self, weights: Weights, proven: Weights | None, seed: int = 0) -> tuple[str, float]:
        """What became of the weights, and the largest excess over the edge [m]."""
        if not self._checks.judge(encode_weights(weights)).packed:
            return "refused as absurd", -math.inf
        before = proven or zero_weights(weights.car, weights.discretisation)
        controller = self._controller(before)
        controller.native.stage_weights(pack_weights(weights))
        controller.native.adopt_weights(weights.version)
        seen: dict[str, Any] = {"sensors": self._sensors, "seed": seed}
        loop = WatchedLoop(self._car, self._track, self._line, controller, **seen)
        history = SimpleNamespace(in_use=SimpleNamespace(proven=False))
        port: Any = SimpleNamespace(step=controller.native, car=self._car, history=history)
        loop.adoption = Adoption(port, GateSettings())
        run = loop.drive(0, self._seconds)
        found = [
            f"{ruling.action} at {cycle}, {run.x[cycle - 1, 3]:.1f} m/s"
            for cycle, ruling in loop.adoption.done
            if isinstance(ruling, Ruling) and ruling.action != "proven"
        ]
        return "; ".join(found) or "kept", float(run.off_track_m.max())

    def _controller(self, weights: Weights) -> PredictiveController:
        return compiled_controller(self._artefact, self._car, self._track, self._line, weights)
