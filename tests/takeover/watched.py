"""A drive in one process whose weights are checked and watched, as a controller process does it."""

import math

from bayesrace.gp.weights import GpWeights, encode_weights, zero_weights
from bayesrace.messages import State
from bayesrace.raceline.cached import racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles import CarParameters
from codegen.build import build
from codegen.settings import BuildSettings
from controller.assembly import compiled_controller
from controller.interface import Environment
from controller.mpc import PredictiveController
from controller.weights.adoption import limits_at, slowed_down
from controller.weights.checks import Checks, Watch
from controller.weights.prediction import Sampler, StateRecord
from controller.weights.settings import GateSettings
from operation.closed_loop import ClosedLoop, Driven

__all__ = ["Course"]


class WatchedLoop(ClosedLoop):
    """A closed loop in which weights are watched: the watch rules after each state."""

    def watch(self, checks: Checks, weights: GpWeights, proven: GpWeights | None) -> None:
        """In the next run, in which the controller has ``weights``, against ``proven`` ones."""
        back = zero_weights(weights.car, weights.discretisation) if proven is None else proven
        self._back = encode_weights(back)
        checks.use(encode_weights(weights), 0, b"" if proven is None else self._back)
        self._gate, self._sampler = checks.settings, Sampler(checks.step_s, self._car)
        self._watch: Watch | None = Watch(checks, [])
        self._slow: Environment | None = None
        self.found: list[str] = []
        """What the watch has done, and when."""

    def _limits(self, state: State) -> Environment | None:
        record = StateRecord(
            state.seq, state.epoch, state.run, state.seq, state.time_s, 0, state.x,
            state.u_applied, True,
        )  # fmt: skip
        sample, fallen_back = self._sampler.add(record), self._cycle.driver.fallen_back
        ruling = self._watch.add(fallen_back, sample) if self._watch else None
        if ruling is not None:
            self.found.append(f"{ruling.action} at {len(self._states)}, {state.x[3]:.1f} m/s")
            if ruling.action == "slow":
                fastest_mps = float(ruling.data["fastest_mps"])
                self._slow = slowed_down(self._gate, self._car, fastest_mps)
            else:
                self._watch = None
                assert isinstance(self._controller, PredictiveController)
                self._controller.set_weights(self._back)
        return None if self._slow is None else limits_at(state.x[3], self._slow)


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
        self._checks.use(b"", 0, b"")
        if not self._checks.judge(encode_weights(weights), []).packed:
            return "refused as absurd", -math.inf
        loop = WatchedLoop(self._car, self._track, self._line, self._controller(weights))
        loop.watch(self._checks, weights, proven)
        run = loop.drive(0, self._seconds)
        return "; ".join(loop.found) or "kept", _excess_m(run)

    def drive_unwatched(self, weights: GpWeights) -> float:
        """The largest excess over the edge without checks and watch [m]."""
        loop = ClosedLoop(self._car, self._track, self._line, self._controller(weights))
        return _excess_m(loop.drive(0, self._seconds))

    def _controller(self, weights: GpWeights) -> PredictiveController:
        return compiled_controller(self._artefact, self._car, self._track, self._line, weights)


def _excess_m(run: Driven) -> float:
    return float(run.off_track_m.max())
