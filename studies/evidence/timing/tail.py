"""How long the longest of many times is: peaks over a threshold, by a generalised Pareto law.

The values are to be maxima of blocks that are independent of each other and alike. Above a high
threshold u their excesses y then follow P(Y > y) = (1 + shape y / scale)^(-1 / shape)
(Pickands 1975; Davison and Smith 1990). The level that a block exceeds with probability p has its
upper confidence limit by the profile likelihood (Coles 2001, section 4.3.3).
"""

from typing import Final

import numpy as np
from pydantic import BaseModel
from scipy.stats import chi2, genpareto

from bayesrace.arrays import Floats

__all__ = ["LEAST_PEAKS", "Tail", "fit_tail"]

LEAST_PEAKS: Final = 30
"""Fewer do not tell a shape."""
_OVER: Final = 0.2
"""Share of the values above the threshold."""
_SIGNIFICANT: Final = 0.05
_SHAPES: Final = -0.5, 1.0
"""Below, maximum likelihood is irregular (Smith 1985); a bounded time has none above 0."""
_GRID: Final[Floats] = np.linspace(*_SHAPES, 301)


class Tail(BaseModel):
    """The law of the values above the threshold; times in the unit of the values."""

    threshold: float
    peaks: int
    share: float
    """Of the values, above the threshold."""
    shape: float
    scale: float
    exceedance: float
    level: float
    """A value is above it with probability ``exceedance``, by the fit ..."""
    upper: float
    """... and with this confidence above no higher one."""
    confidence: float
    goodness_p: float
    """Of the Anderson-Darling statistic, by a parametric bootstrap."""
    light_p: float
    """Of a shape of 0 or below, as the times of bounded work have, against one above."""

    @property
    def rejected(self) -> str:
        """Why the fit says nothing; empty: it may be used."""
        if self.light_p < _SIGNIFICANT:
            return f"heavy tail (shape {self.shape:.2f}, p = {self.light_p:.3f})"
        if self.goodness_p < _SIGNIFICANT:
            return f"not of this law (Anderson-Darling, p = {self.goodness_p:.3f})"
        return ""

    def survival(self, values: Floats) -> Floats:
        """P(value > x) from the threshold on."""
        return self.share * np.asarray(
            genpareto.sf(values - self.threshold, self.shape, scale=self.scale), dtype=np.float64
        )


def fit_tail(
    values: Floats, exceedance: float, confidence: float = 0.95, samples: int = 199
) -> Tail | None:
    """The tail of independent values (n,); None where there are too few, or too many alike.

    ``samples``: of the bootstrap behind the goodness of fit.
    """
    threshold = float(np.quantile(values, 1 - _OVER))
    y = values[values > threshold] - threshold
    if len(y) < LEAST_PEAKS or len(np.unique(y)) < LEAST_PEAKS // 2:
        return None
    share, random = len(y) / len(values), np.random.default_rng(0)
    shape, scale = _fit(y)
    rarer = max(share / exceedance, 1.0)
    level = scale * float(_growth(np.array(shape), rarer))
    gain = _log_likelihood(y, shape, scale) - _log_likelihood(y, 0.0, float(y.mean()))
    drawn = (
        np.asarray(genpareto.rvs(shape, scale=scale, size=len(y), random_state=random))
        for _ in range(samples)
    )
    worse = sum(_anderson(one, *_fit(one)) >= _anderson(y, shape, scale) for one in drawn)
    return Tail(
        threshold=threshold, peaks=len(y), share=share, shape=shape, scale=scale,
        exceedance=exceedance, confidence=confidence,
        level=threshold + level, upper=threshold + _upper(y, rarer, level, confidence),
        goodness_p=(1 + worse) / (1 + samples),
        light_p=0.5 * float(chi2.sf(2 * max(gain, 0.0), 1)) if shape > 0 else 1.0,
    )  # fmt: skip


def _growth(shape: Floats, rarer: float) -> Floats:
    """Of a level exceeded by one of so many peaks, in scales."""
    small = np.abs(shape) < 1e-9
    safe = np.where(small, 1.0, shape)
    grown: Floats = np.where(small, np.log(rarer), np.expm1(safe * np.log(rarer)) / safe)
    return grown


def _log_likelihoods(y: Floats, shapes: Floats, scales: Floats) -> Floats:
    """Of each pair of shape and scale, (k,); -inf where a peak is beyond the law's end."""
    shapes = np.where(np.abs(shapes) < 1e-9, 1e-9, shapes)
    z = 1 + (shapes / scales)[:, None] * y
    inside = (z > 0).all(axis=1)
    logs = np.log(np.where(z > 0, z, 1.0)).sum(axis=1)
    return np.where(inside, -len(y) * np.log(scales) - (1 + 1 / shapes) * logs, -np.inf)


def _log_likelihood(y: Floats, shape: float, scale: float) -> float:
    return float(_log_likelihoods(y, np.array([shape]), np.array([scale]))[0])


def _fit(y: Floats) -> tuple[float, float]:
    """Shape and scale of the largest likelihood, by one number, their quotient (Grimshaw 1993)."""
    end, mean = 1 / y.max(), 1 / y.mean()
    below, above = -end * (1 - np.geomspace(1e-4, 0.999, 60)), mean * np.geomspace(1e-4, 20, 60)
    quotients: Floats = np.concatenate([below, above])
    for _ in range(3):
        shapes = np.log1p(quotients[:, None] * y).mean(axis=1)
        scales = shapes / quotients
        likely = -np.log(scales) - shapes - 1
        likely[(shapes < _SHAPES[0]) | (shapes > _SHAPES[1])] = -np.inf
        best = int(np.argmax(likely))
        found = float(shapes[best]), float(scales[best])
        around = quotients[[max(best - 1, 0), min(best + 1, len(quotients) - 1)]].tolist()
        quotients = np.linspace(around[0], around[1], 40)
        quotients = quotients[quotients != 0]
    return found


def _upper(y: Floats, rarer: float, level: float, confidence: float) -> float:
    """One-sided limit of the level: where the profile likelihood has fallen far enough."""
    growth = _growth(_GRID, rarer)

    def profile(at: float) -> float:
        return float(_log_likelihoods(y, _GRID, at / growth).max())

    least = profile(level) - 0.5 * float(chi2.ppf(2 * confidence - 1, 1))
    low, high = level, 2 * level
    while profile(high) > least and high < 1e9 * level:
        low, high = high, 2 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if profile(middle) > least else (low, middle)
    return high


def _anderson(y: Floats, shape: float, scale: float) -> float:
    """The Anderson-Darling statistic."""
    n = len(y)
    u = np.clip(genpareto.cdf(np.sort(y), shape, scale=scale), 1e-12, 1 - 1e-12)
    i = np.arange(1, n + 1)
    return float(-n - np.mean((2 * i - 1) * (np.log(u) + np.log1p(-u[::-1]))))
