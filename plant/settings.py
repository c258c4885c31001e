"""What is chosen of a simulated car: who simulates it, and what measures it."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from bayesrace.defaults import Option
from bayesrace.plant.world import UNCHANGED, World, WorldSetting
from bayesrace.sensors import Sensors, SensorsSetting
from bayesrace.strict import StrictModel
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["CarSimulation", "SimulatorName"]

SimulatorName = Literal["equations", "slipx"]
"""What simulates the car where no FMU does."""


class CarSimulation(StrictModel):
    """The car, what simulates it, and what lies between it and the controller."""

    car: CarSetting = Field(default_factory=default_car)
    fmu: Path | None = Field(
        None, description="Co-Simulation FMU (2.0, 3.0) that simulates the car"
    )
    fmu_map: Annotated[Path | None, Option("--map")] = Field(
        None,
        description="map of the FMU's variables (TOML), which 'bayesrace fmu inspect' writes to be "
        "filled in; None: they have our names",
    )
    simulator: SimulatorName = Field(
        "equations",
        description="what simulates the car without an FMU: equations, or slipx, for --car slipx",
    )
    delay_s: Annotated[float, Option(unit="ms", per_unit=1000)] = Field(
        0.0, ge=0, le=1, description="delay put on states and on actuations each"
    )
    sensors: SensorsSetting = None
    world: WorldSetting = None

    @property
    def states_hz(self) -> float:
        """Rate of the states."""
        return 50.0

    @property
    def instruments(self) -> Sensors:
        """Those chosen, or the car's own."""
        return self.car.sensors if self.sensors is None else self.sensors

    @property
    def changes(self) -> World:
        """What changes while the car drives."""
        return self.world or UNCHANGED

    @model_validator(mode="after")
    def _can_change(self) -> Self:
        if self.changes.root:
            if self.fmu is not None or self.simulator != "equations":
                raise ValueError("world: only the built-in car can change while it drives")
            self.changes.check(self.car)
        return self

    @model_validator(mode="after")
    def _readings_fit(self) -> Self:
        self.instruments.check_rate(self.states_hz)
        return self
