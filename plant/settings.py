"""What is chosen of a simulated car: who simulates it, and how well its sensors measure."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.defaults import Option
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["CarSimulation", "SensorNoise", "SimulatorName"]

SimulatorName = Literal["equations", "slipx"]
"""What simulates the car where no FMU does."""


class SensorNoise(BaseModel):
    """Standard deviations of the measured state: white, Gaussian, independent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_m: float = Field(0.0, ge=0, le=1, description="noise of x and of y [m]")
    heading_rad: float = Field(0.0, ge=0, le=1, description="noise of the heading [rad]")
    speed_mps: float = Field(0.0, ge=0, le=10, description="noise of vx and of vy [m/s]")
    yaw_rate_radps: float = Field(0.0, ge=0, le=10, description="noise of the yaw rate [rad/s]")
    steering_rad: float = Field(0.0, ge=0, le=1, description="noise of the steering angle [rad]")

    @property
    def deviations(self) -> tuple[float, ...]:
        """Of the state [x, y, psi, vx, vy, omega, delta], shape (7,)."""
        position, speed = self.position_m, self.speed_mps
        return (
            position, position, self.heading_rad, speed, speed, self.yaw_rate_radps,
            self.steering_rad,
        )  # fmt: skip


class CarSimulation(BaseModel):
    """The car, what simulates it, and what lies between it and the controller."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    noise: Annotated[SensorNoise, Option(metavar="NAME=STD")] = Field(
        SensorNoise(), description="standard deviation of a sensor; empty: exact"
    )
