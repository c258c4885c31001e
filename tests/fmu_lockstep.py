"""What the tests of the controller's FMU share: the lockstep run that it must drive, exports."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesrace.gp.weights import GpWeights
from bayesrace.messages import State
from bayesrace.vehicles import CarParameters, get_car
from bayesrace.vehicles.models import dynamic
from codegen.fmu import FmuDefinition, pack
from codegen.fmu.controller import controller_fmu
from controller.compensation import CompensationSettings
from controller.driver import Driver
from controller.fallback import FallbackSettings
from controller.mpc import PredictiveController
from controller.native_step import NativeStep, StepStatus
from plant.fmu.export import car_fmu
from plant.simulator import Simulator
from tests.conftest import SETTINGS, Circuit
from tests.fmu_master import STATES, Slave

__all__ = [
    "RACING",
    "STEPS",
    "STEP_S",
    "Exported",
    "Lockstep",
    "answers",
    "make_exported",
    "make_lockstep",
    "same",
    "strewn",
    "versions",
]

Floats = NDArray[np.float64]

versions = pytest.mark.parametrize("version", [2, 3])

STEP_S = 0.02
STEPS = 500
"""A start at .1 m/s and three laps."""

RACING = SETTINGS.model_copy(update={"iterations": 3})
FALLBACK = FallbackSettings()


@dataclass
class Lockstep:
    """Driver and plant in one process, as the two processes of a lockstep run have them."""

    native: NativeStep
    car: CarParameters
    delay_s: float = 0.0
    x: list[Floats] = field(default_factory=list)
    u: list[Floats] = field(default_factory=list)
    said: list[tuple[int, int]] = field(default_factory=list)
    """Status and level."""

    def __post_init__(self) -> None:
        compensation = CompensationSettings(mode="fixed", delay_s=self.delay_s)
        controller = PredictiveController(self.native)
        self.driver = Driver(controller, self.car, FALLBACK, compensation, 0.06, 1.5)
        self.plant = Simulator(dynamic(self.car))

    def answer(self, seq: int, x: Floats) -> Floats:
        """The input for one state."""
        state = State(
            source_time_ns=0, run=1, time_s=seq * STEP_S, x=tuple(x), lap=0, seq=seq, epoch=1,
            u_applied=self.plant.u_applied, lockstep=not self.delay_s, answers=(), final=False,
        )  # fmt: skip
        self.driver.observe(state)
        self.driver.decide(state, state.time_s)
        decision = self.driver.settle()
        self.driver.prepare(STEP_S)
        self.x.append(x)
        self.u.append(np.array([decision.d, decision.delta_rate]))
        self.said.append((decision.status, int(decision.level)))
        return self.u[-1]

    def run(
        self, start: Floats, count: int, spoil: Callable[[int, Floats], Floats] = lambda _, x: x
    ) -> "Lockstep":
        """``count`` steps from ``start``; ``spoil``: what is measured instead of a state."""
        self.plant.reset([*start])
        before = np.zeros(2)
        for k in range(count):
            u = self.answer(k, spoil(k, self.plant.x.copy()))
            self.plant.step([*(before if self.delay_s else u)])
            before = u
        return self


@dataclass(frozen=True)
class Exported:
    """FMUs made once, and folders they are extracted to once."""

    folder: Path
    define: Callable[..., FmuDefinition]

    def fmu(self, version: Literal[2, 3], cpu: str = "native") -> Path:
        """The controller's."""
        out = self.folder / f"controller{version}-{cpu}.fmu"
        return out if out.exists() else pack(self.define(version=version, cpu=cpu), out)

    def plant(self, version: Literal[2, 3]) -> Path:
        """The car's."""
        out = self.folder / f"car{version}.fmu"
        return out if out.exists() else pack(car_fmu(get_car("orca"), version), out)

    def slave(
        self, fmu: Path, values: Mapping[str, float] | None = None, name: str = "one"
    ) -> Slave:
        """Ready to be stepped."""
        slave = Slave(fmu, fmu.with_suffix(""), name)
        slave.initialise(values)
        return slave


def make_exported(
    folder: Path, artefact: Path, car: CarParameters, circuit: Circuit, weights: GpWeights
) -> Exported:
    """Exports into ``folder`` of the controller on the circuit; what is there is taken."""

    def define(**changes: Any) -> FmuDefinition:
        values: dict[str, Any] = {
            "artefact": artefact,
            "car": car,
            "rows": circuit.table.rows,
            "spacing_m": circuit.table.spacing_m,
            "settings": RACING.model_dump(),
            "fallback": FALLBACK.model_dump(),
            "weights": weights,
        }
        return controller_fmu(**(values | changes))

    folder.mkdir(exist_ok=True)
    return Exported(folder, define)


def make_lockstep(
    artefact: Path, car: CarParameters, circuit: Circuit, weights: GpWeights, delay_s: float = 0.0
) -> Lockstep:
    """Not yet run."""
    native = NativeStep(artefact, car, RACING)
    native.set_weights(weights)
    native.set_path(circuit.table)
    return Lockstep(native, car, delay_s)


def strewn(k: int, x: Floats) -> Floats:
    """Bad measurements: single ones, long rows, and an angle from which nothing is feasible."""
    bad = (np.nan, np.inf, -np.inf, 1e300)
    if k % 40 == 20 or 100 <= k < 110 or 200 <= k < 260:
        x[k % 7] = bad[k % 4]
    elif k % 40 == 30:
        x[6] = 0.6
    return x


def answers(slave: Slave, states: list[Floats], h: float = STEP_S) -> Floats:
    """What an FMU says to states that are given: d, delta_rate, status, level."""
    rows = []
    for x in states:
        slave.set(dict(zip(STATES, x, strict=True)))
        slave.step(h)
        rows.append(slave.get("d", "delta_rate", "status", "fallback_level"))
    return np.array(rows)


def same(rows: Floats, run: Lockstep) -> None:
    """To the bit, whatever a good status is called."""
    expected = [(*u, *said) for u, said in zip(run.u, run.said, strict=True)]
    rows = rows.copy()
    rows[rows[:, 2] == StepStatus.ACCEPTABLE, 2] = 0
    np.testing.assert_array_equal(rows, np.array(expected))
