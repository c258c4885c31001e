"""What is chosen of a simulated car: who simulates it, and how well its sensors measure."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["SensorNoise", "SimulatorName"]

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
