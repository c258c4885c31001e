"""A plain FMI master: fmpy loads and steps FMUs, nothing of ours is in the loop.

The master knows both FMI versions; an instance here is what such a tool shows of it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import fmpy.fmi2
import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from bayesrace.arrays import Floats
from bayesrace.vehicles.models import STATES

__all__ = ["Slave", "drive"]


class Slave:
    """One instance of a Co-Simulation FMU that was extracted to ``folder``."""

    def __init__(self, fmu: Path, folder: Path, name: str = "one") -> None:
        if not (folder / "modelDescription.xml").exists():
            extract(str(fmu), unzipdir=str(folder))
        self.description = read_model_description(str(folder), validate=False)
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.kinds = {v.name: v.type for v in self.description.modelVariables}
        self.two = self.description.fmiVersion.startswith("2")
        self.messages: list[str] = []
        kind: Any = FMU2Slave if self.two else FMU3Slave
        self.fmu: Any = kind(
            guid=self.description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName=name,
        )
        self.fmu.instantiate(**self._logging())
        self.time = 0.0

    def _logging(self) -> dict[str, Any]:
        """What collects the FMU's messages."""
        if not self.two:
            return {"logMessage": lambda _, status, category, text: self._log(text)}

        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(
            lambda _, name, status, category, text: self._log(text)
        )
        callbacks.allocateMemory = fmpy.fmi2.defaultCallbacks.allocateMemory
        callbacks.freeMemory = fmpy.fmi2.defaultCallbacks.freeMemory
        return {"callbacks": callbacks}

    def _log(self, text: bytes) -> None:
        self.messages.append(text.decode())

    def initialise(self, values: Mapping[str, float] | None = None) -> None:
        """From instantiated to stepping, with these values set before."""
        self.time = 0.0
        if self.two:
            self.fmu.setupExperiment(startTime=0.0)
        for name, value in (values or {}).items():
            self.set({name: value})
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, values: Mapping[str, float]) -> None:
        """Sets variables of any kind."""
        for name, value in values.items():
            setter, number = self._access("set", name)
            setter([self.references[name]], [number(value)])

    def get(self, *names: str) -> list[float]:
        """Values of variables of any kind."""
        return [float(self._access("get", n)[0]([self.references[n]])[0]) for n in names]

    def _access(self, what: str, name: str) -> tuple[Any, Any]:
        kind = self.kinds[name]
        number = {"Real": float, "Float64": float, "Boolean": bool}.get(kind, int)
        return getattr(self.fmu, f"{what}{kind}"), number

    def step(self, h: float) -> None:
        """One doStep."""
        self.fmu.doStep(currentCommunicationPoint=self.time, communicationStepSize=h)
        self.time += h

    def reset(self) -> None:
        """Back to instantiated."""
        self.fmu.reset()

    def close(self) -> None:
        """Ends and frees the instance."""
        self.fmu.terminate()
        self.fmu.freeInstance()


def drive(
    car: Slave, controller: Slave, count: int, h: float = 0.02, parallel: bool = False
) -> tuple[Floats, Floats]:
    """States (count, 7) and inputs (count, 2) of the loop of both, which are initialised.

    The controller is stepped first, and the car with what it says; ``parallel``: both at once, so
    that the car gets it one step later.
    """
    states, inputs = np.zeros((count, 7)), np.zeros((count, 2))
    u: Sequence[float] = (0.0, 0.0)
    for k in range(count):
        x = car.get(*STATES)
        controller.set(dict(zip(STATES, x, strict=True)))
        before = u
        controller.step(h)
        u = controller.get("d", "delta_rate")
        states[k], inputs[k] = x, u
        d, delta_rate = before if parallel else u
        car.set({"d": d, "delta_rate": delta_rate})
        car.step(h)
    return states, inputs
