"""Which speeds with which lateral accelerations racing lines ask for, and which of them were driven
before.

What a car does at a speed says little about a faster one, and in a straight little about a bend at
the same speed. So a lap is compared with what was driven in both at once: a place of the line is
known if a sample is near it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from bayesrace.arrays import Flags, Floats
from bayesrace.raceline import RaceLine

__all__ = ["NEAR", "Coverage", "asked", "coverage"]

NEAR: Final = (1 / 16, 1 / 8)
"""Of the largest speed and of the largest lateral acceleration of the lines: the distances within
which a sample is near."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """The places (n, 2) of lines, [m/s, m/s²], for how long they are driven (n,) [s], which of them
    are near a sample (n,), and the samples (m, 2)."""

    asked: Floats
    duration_s: Floats
    near: Flags
    driven: Floats

    @property
    def share(self) -> float:
        """Of the time of the lines, near samples."""
        return float(self.duration_s[self.near].sum() / self.duration_s.sum())

    def with_samples(self, more: Floats) -> "Coverage":
        """The same if these (m, 2) are driven as well."""
        near = self.near | _near(self.asked, more)
        return Coverage(self.asked, self.duration_s, near, np.vstack([self.driven, more]))

    def __str__(self) -> str:
        """In words, with what is missing."""
        text = f"{100 * self.share:.0f} % of the racing line's time is at speeds and lateral "
        text += "accelerations that were driven"
        if self.near.all():
            return text
        speed, across = self.asked[~self.near].T
        return (
            f"{text}; drive {speed.min():.2f} to {speed.max():.2f} m/s with "
            f"{across.min():.1f} to {across.max():.1f} m/s² across, slowly at first"
        )


def asked(lines: Sequence[RaceLine]) -> Floats:
    """The places (n, 2) of all lines: speed [m/s], lateral acceleration to either side [m/s²]."""
    speed = np.concatenate([line.vx_mps for line in lines])
    curvature = np.concatenate([line.kappa_radpm for line in lines])
    return np.column_stack([speed, speed**2 * np.abs(curvature)])


def coverage(lines: Sequence[RaceLine], x: Floats) -> Coverage:
    """How much of what the lines ask for a car has been in that was in the states x (m, 7)."""
    places, driven = asked(lines), np.column_stack([x[:, 3], np.abs(x[:, 3] * x[:, 5])])
    duration_s = np.concatenate([line.duration_s for line in lines])
    return Coverage(places, duration_s, _near(places, driven), driven)


def _near(places: Floats, driven: Floats) -> Flags:
    """Which of the places (n, 2) have a sample (m, 2) near them."""
    if not len(driven):
        return np.zeros(len(places), dtype=bool)
    scale = np.array(NEAR) * np.maximum(places.max(axis=0), 1e-9)
    return np.asarray(cKDTree(driven / scale).query(places / scale)[0] <= 1)
