"""The car's sensors: the one place where a measurement is made of the truth."""

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

__all__ = ["SensorNoise", "Sensors"]


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


class Sensors:
    """What measures one run: the same seed gives each run the same noise."""

    def __init__(self, noise: SensorNoise | None = None, seed: int = 0) -> None:
        deviations = (noise or SensorNoise()).deviations
        self._deviations = np.array(deviations) if any(deviations) else None
        self._random = np.random.default_rng(seed)

    def measure(self, x: tuple[float, ...]) -> tuple[float, ...]:
        """What the sensors measure of the true state x (7,)."""
        if self._deviations is not None:
            noise = self._deviations * self._random.standard_normal(len(x))
            x = tuple((np.array(x) + noise).tolist())
        return x
