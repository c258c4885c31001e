"""The car's sensors: the one place where a measurement is made of the truth."""

import numpy as np

from plant.settings import SensorNoise

__all__ = ["Sensors"]


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
