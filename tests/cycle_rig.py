"""A control cycle around a control law that the test writes, without plant or messages."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bayesrace.arrays import Floats
from bayesrace.controller.driver import Driver
from bayesrace.controller.interface import Environment, StepOutput
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.python_controller import PythonController
from bayesrace.messages import State
from bayesrace.vehicles import Car, default_car
from tests import sample_messages as messages

__all__ = ["STEP_S", "ScriptedLaw", "scripted_driver", "state"]


STEP_S = 0.02


class ScriptedLaw:
    """Answers by a function of the state; without one it raises."""

    def __init__(
        self,
        answer: Callable[[Floats], StepOutput] | None = None,
        model: Callable[[Floats, Floats, float], Floats] = lambda x, _u, _s: x,
    ) -> None:
        self.answer, self.predict = answer, model

    def reset(self) -> None:
        """It has no past."""

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment,
        elapsed_s: float,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """By the function."""
        if self.answer is None:
            raise RuntimeError("no step today")
        return self.answer(x)


def scripted_driver(
    artefact: Path, law: ScriptedLaw, car: Car | None = None, **settings: Any
) -> Driver:
    """The car's, by default the default car's, driven by the law; with settings of the process."""
    # Without a monitor: the states of these rigs follow no kinematics.
    chosen = ControllerSettings(**{"stale_s": 60.0, "sensor_tolerance": 0.0} | settings)
    return Driver(PythonController(artefact, law), car or default_car(), chosen)


def state(seq: int, **changes: Any) -> State:
    """A state of a free-running plant that samples every 20 ms."""
    return messages.state(seq, **({"time_s": seq * STEP_S} | changes))
