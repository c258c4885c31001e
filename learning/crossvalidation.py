"""Held-out errors of a GP on contiguous blocks, in closed form from one inverse.

Neighbouring samples of a drive are 20 ms apart and nearly alike. Leaving out single samples asks
only for interpolation between neighbours and is over-optimistic; leaving out whole stretches asks
what driving elsewhere asks. For a block B (Rasmussen and Williams, section 5.4.2, blockwise)

    y_B - mean_B = C [K^-1 y]_B,    covariance_B = C,    C = ([K^-1]_BB)^-1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["HeldOut", "held_out"]

Floats = NDArray[np.float64]

_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class HeldOut:
    """Errors and predictive standard deviations (noise included) of scaled targets, (n,)."""

    error: Floats
    sigma: Floats

    @property
    def log_density(self) -> float:
        """Mean log predictive density per sample."""
        score = (self.error / self.sigma) ** 2 + np.log(2 * np.pi * self.sigma**2)
        return float(-0.5 * score.mean())

    @property
    def rmse(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def coverage(self) -> float:
        """Share of errors within the 95 % interval."""
        return float(np.mean(np.abs(self.error) <= _NORMAL_95 * self.sigma))

    @property
    def variance_scale(self) -> float:
        """Factor on all variances that makes the 95 % interval hold 95 % of the errors."""
        ratio = np.quantile(np.abs(self.error) / self.sigma, 0.95) / _NORMAL_95
        return float(ratio**2)


def held_out(inverse: Floats, y: Floats, blocks: int) -> HeldOut:
    """Held-out errors for ``blocks`` contiguous blocks, given K^-1 (n, n) with noise in K."""
    alpha = inverse @ y
    error, sigma = np.empty_like(y), np.empty_like(y)
    for rows in np.array_split(np.arange(len(y)), min(blocks, len(y))):
        covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
        error[rows] = covariance @ alpha[rows]
        sigma[rows] = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    return HeldOut(error, sigma)
