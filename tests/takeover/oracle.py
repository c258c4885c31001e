"""What a controller with given weights would have sent: the compiled step, in this process."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import make_path_table, predictive_controller
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.driver import Decision
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import GpWeights
from bayesrace.messages import State
from bayesrace.vehicles import get_car
from tests.network.cars import Course

__all__ = ["converged", "replayed"]


CAR = get_car("orca")


def replayed(course: Course, states: Sequence[State], weights: Mapping[int, GpWeights]) -> Floats:
    """Inputs (n, 2) of a controller that answers these states of a lockstep run, one by one.

    ``weights``: new ones, by the index of the first state that they answer.
    """
    files = course.track_file, course.line_file
    controller = predictive_controller(course.artefact, CAR, *files, weights=course.weights_file)
    cycle = Cycle(controller, CAR, ControllerSettings())
    inputs: list[tuple[float, float]] = []

    def take_over() -> None:
        if len(inputs) in weights:
            controller.native.set_weights(weights[len(inputs)])

    def send(_: State, decision: Decision) -> None:
        inputs.append((decision.d, decision.delta_rate))
        take_over()

    take_over()
    for state in states:
        assert cycle.driver.observe(state)
        cycle.answer(state, send)
    return np.array(inputs)


def converged(course: Course, weights: GpWeights, x: ArrayLike, d_previous: float) -> Floats:
    """The optimal input (2,) at state x (7,), from a guess that knows no plan."""
    step = NativeStep(course.artefact, CAR, MpcSettings())
    step.set_path(make_path_table(course.track, course.line, CAR.tuning.path.spacing_m))
    step.set_weights(weights)
    status = step.step(np.array(x), d_previous)
    assert status.usable, status
    return step.u.copy()
