"""How long the longest of many times is: peaks over a threshold, by a generalised Pareto law.

The values are to be maxima of blocks that are independent of each other and alike. Above a high
threshold u their excesses y then follow P(Y > y) = (1 + shape y / scale)^(-1 / shape)
(Pickands 1975; Davison and Smith 1990). The level that a block exceeds with probability p has its
upper confidence limit by the profile likelihood (Coles 2001, section 4.3.3).
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel
from scipy.optimize import brentq, minimize_scalar
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
    """The tail of independent values (n,); None where there are too few, or too many alike, or the
    level would not be above the threshold.

    ``samples``: of the bootstrap behind the goodness of fit.
    """
    threshold = float(np.quantile(values, 1 - _OVER))
    y = values[values > threshold] - threshold
    share = len(y) / len(values)
    if len(y) < LEAST_PEAKS or len(np.unique(y)) < LEAST_PEAKS // 2 or share <= exceedance:
        return None
    shape, scale = _fit(y)
    level = float(genpareto.isf(exceedance / share, shape, scale=scale))
    gain = float((_log_likelihood(y, shape, scale) - _log_likelihood(y, 0.0, y.mean()))[0])
    apart = _anderson(y, shape, scale)
    drawn = genpareto.rvs(shape, scale=scale, size=(samples, len(y)), random_state=0)
    worse = sum(_anderson(one, *_fit(one)) >= apart for one in drawn)
    return Tail(
        threshold=threshold, peaks=len(y), share=share, shape=shape, scale=scale,
        exceedance=exceedance, confidence=confidence,
        level=threshold + level,
        upper=threshold + _upper(y, exceedance / share, level, confidence),
        goodness_p=(1 + worse) / (1 + samples),
        light_p=0.5 * float(chi2.sf(2 * max(gain, 0.0), 1)) if shape > 0 else 1.0,
    )  # fmt: skip


def _log_likelihood(y: Floats, shapes: ArrayLike, scales: ArrayLike) -> Floats:
    """Of each pair of shape and scale, (k,)."""
    shapes, scales = (np.reshape(one, (-1, 1)) for one in (shapes, scales))
    return np.asarray(genpareto.logpdf(y, shapes, scale=scales).sum(axis=1))


def _fit(y: Floats) -> tuple[float, float]:
    """Shape and scale of the largest likelihood, by one number, their quotient (Grimshaw 1993)."""

    def shape(quotient: float) -> float:
        return float(np.log1p(quotient * y).mean())

    def cost(quotient: float) -> float:
        return float(np.log(shape(quotient) / quotient)) + shape(quotient)

    low, high = (-1 + 1e-9) / y.max(), 7 / np.median(y)  # there the shape is above 1
    high = brentq(lambda at: shape(at) - _SHAPES[1], low, high)
    if shape(low) < _SHAPES[0]:
        low = brentq(lambda at: shape(at) - _SHAPES[0], low, high)
    quotient = minimize_scalar(cost, bounds=(low, high), method="bounded").x
    return shape(quotient), shape(quotient) / quotient


def _upper(y: Floats, exceedance: float, level: float, confidence: float) -> float:
    """One-sided limit of the level that a peak exceeds so seldom: where the profile likelihood has
    fallen far enough."""
    growth = genpareto.isf(exceedance, _GRID)

    def profile(at: float) -> float:
        return float(_log_likelihood(y, _GRID, at / growth).max())

    least = profile(level) - 0.5 * float(chi2.ppf(2 * confidence - 1, 1))
    high = 2 * level
    while profile(high) > least:
        high *= 2
    return float(brentq(lambda at: profile(at) - least, level, high, rtol=1e-6))


def _anderson(y: Floats, shape: float, scale: float) -> float:
    """The Anderson-Darling statistic."""
    n = len(y)
    u = np.clip(genpareto.cdf(np.sort(y), shape, scale=scale), 1e-12, 1 - 1e-12)
    i = np.arange(1, n + 1)
    return float(-n - np.mean((2 * i - 1) * (np.log(u) + np.log1p(-u[::-1]))))
