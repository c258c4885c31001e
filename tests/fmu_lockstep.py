"""What the tests of the controller's FMU share: the lockstep run that it must drive, exports.

The fixture ``exported`` is there for modules that import its function.
"""

import fcntl
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.arrays import Floats
from bayesrace.codegen.fmu import FmuDefinition, controller_fmu, pack
from bayesrace.controller.assembly import PredictiveController
from bayesrace.controller.driver import Driver
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import CompensationSettings, FallbackSettings
from bayesrace.gp.weights import Weights
from bayesrace.messages import Reading
from bayesrace.plant.sensors import SensorPlayer
from bayesrace.plant.simulator import Simulator
from bayesrace.sensors import EXACT, Sensors
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import STATES, dynamic
from tests import sample_messages as messages
from tests.conftest import SETTINGS, Circuit
from tests.fmu_master import Slave

__all__ = [
    "RACING",
    "STEPS",
    "STEP_S",
    "Exported",
    "Lockstep",
    "answers",
    "exported_controllers",
    "same",
    "strewn",
    "versions",
]


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
    car: Car
    delay_s: float = 0.0
    tolerance: float = 1.0
    """Of the sensors; 0: every state is believed."""
    x: list[Floats] = field(default_factory=list)
    u: list[Floats] = field(default_factory=list)
    said: list[tuple[int, int]] = field(default_factory=list)
    """Status and level."""
    applied: list[tuple[float, ...]] = field(default_factory=list)
    """In the period before each state."""
    sensors: Sensors = EXACT
    readings: list[tuple[Reading, ...]] = field(default_factory=list)
    """Of the sensors, if there are any; then states are not known."""

    def __post_init__(self) -> None:
        compensation = CompensationSettings(mode="fixed", delay_s=self.delay_s)
        controller = PredictiveController(self.native)
        settings = ControllerSettings(
            fallback=FALLBACK, compensation=compensation, sensor_tolerance=self.tolerance
        )
        self.driver = Driver(controller, self.car, settings)
        self.plant = Simulator(dynamic(self.car))
        self.player = SensorPlayer(self.sensors)

    def answer(self, seq: int, x: Floats) -> Floats:
        """The input for one state."""
        state = messages.state(
            seq, time_s=seq * STEP_S, x=tuple(x), u_applied=self.plant.u_applied,
            lockstep=not self.delay_s,
        )  # fmt: skip
        if self.sensors.root:
            self.readings.append(self.player.report(state.time_s, state.x))
            state = replace(state, x=(0.0,) * 7, estimated=True, readings=self.readings[-1])
        self.driver.observe(state)
        decision = self.driver.decide(state.time_s)
        self.driver.prepare(STEP_S)
        self.x.append(x)
        self.applied.append(state.u_applied)
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
    """FMUs of the controller on a circuit, made once, and folders they are extracted to once."""

    folder: Path
    shared: Path
    """With the test processes beside this one: they take seconds to compile."""
    artefact: Path
    car: Car
    circuit: Circuit
    weights: Weights

    def define(self, **changes: Any) -> FmuDefinition:
        """The controller's definition."""
        values: dict[str, Any] = {
            "artefact": self.artefact,
            "car": self.car,
            "rows": self.circuit.table.rows,
            "spacing_m": self.circuit.table.spacing_m,
            "settings": RACING.parameters(self.car),
            "fallback": FALLBACK.model_dump() | {"brake_fade_mps": self.car.brake_fade_mps},
            "weights": self.weights,
        }
        return controller_fmu(**(values | changes))

    def lockstep(
        self, delay_s: float = 0.0, tolerance: float = 1.0, sensors: Sensors = EXACT
    ) -> Lockstep:
        """The same controller in one process with the plant."""
        native = NativeStep(self.artefact, self.car, RACING)
        native.set_weights(self.weights)
        native.set_path(self.circuit.table)
        return Lockstep(native, self.car, delay_s, tolerance, sensors=sensors)

    def fmu(self, version: Literal[2, 3]) -> Path:
        """The controller's."""
        out = self.shared / f"controller{version}.fmu"
        with out.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return out if out.exists() else pack(self.define(version=version), out)

    def slave(
        self, fmu: Path, values: Mapping[str, float] | None = None, name: str = "one"
    ) -> Slave:
        """Ready to be stepped."""
        slave = Slave(fmu, self.folder / fmu.stem, name)
        slave.initialise(values)
        return slave


@pytest.fixture(scope="session", name="exported")
def exported_controllers(
    tmp_path_factory: pytest.TempPathFactory,
    kinematic_artefact: Path,
    car: Car,
    circuit: Circuit,
    weights: Weights,
) -> Exported:
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = tmp_path_factory.mktemp("exported")
    return Exported(folder, shared, kinematic_artefact, car, circuit, weights)


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


def same(rows: Floats, run: Lockstep, tolerance: float = 0.0) -> None:
    """To the bit, or but for rounding; whatever a good status is called."""
    expected = [(*u, *said) for u, said in zip(run.u, run.said, strict=True)]
    rows = rows.copy()
    rows[rows[:, 2] == Status.ACCEPTABLE, 2] = 0
    np.testing.assert_allclose(rows, np.array(expected), rtol=0, atol=tolerance)
