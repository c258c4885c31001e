"""The optimised path between its stations, evaluated exactly as the optimisation assumed it."""

from dataclasses import dataclass

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.line import RaceLine
from bayesrace.tracks import StartLine, Track

__all__ = ["Clothoids", "sample_line"]

_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True, eq=False)
class Clothoids:
    """Closed chain of n clothoids with piecewise linear acceleration; arrays (n,)."""

    xy_m: Floats
    psi_rad: Floats
    kappa_radpm: Floats
    energy: Floats
    """Squared speed [m^2/s^2]."""
    ax_mps2: Floats
    step_m: Floats
    """Arc length from each station to the next."""
    turn_rad: float
    """Direction gained over the lap, +-2 pi."""

    @property
    def length_m(self) -> float:
        """Arc length of the whole path."""
        return float(self.step_m.sum())

    def at(self, s: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """xy (m, 2), psi, kappa, v, ax at arc lengths (m,) from station 0, up to two laps on."""
        lap, rest = np.divmod(s, self.length_m)
        knots = np.concatenate([[0.0], np.cumsum(self.step_m[:-1])])
        k = np.searchsorted(knots, rest, side="right") - 1
        after = (k + 1) % len(knots)
        length, t = self.step_m[k], rest - knots[k]
        bend = (self.kappa_radpm[after] - self.kappa_radpm[k]) / length
        gain = (self.ax_mps2[after] - self.ax_mps2[k]) / length

        def psi(way: Floats) -> Floats:
            start = (slice(None),) + (None,) * (way.ndim - 1)
            turned = way * (self.kappa_radpm[k][start] + way * bend[start] / 2)
            return np.asarray(self.psi_rad[k][start] + turned)

        inner = psi(t[:, None] * (_GAUSS_X + 1) / 2)
        weight = t[:, None] * _GAUSS_W / 2
        offset = np.column_stack(
            [np.sum(np.cos(inner) * weight, axis=1), np.sum(np.sin(inner) * weight, axis=1)]
        )
        energy = self.energy[k] + t * (2 * self.ax_mps2[k] + t * gain)
        return (
            self.xy_m[k] + offset,
            psi(t) + lap * self.turn_rad,
            self.kappa_radpm[k] + bend * t,
            np.sqrt(energy),
            self.ax_mps2[k] + gain * t,
        )


def sample_line(track: Track, path: Clothoids, spacing_m: float) -> RaceLine:
    """Evenly spaced points along the path, the first on the track's start line."""
    count = max(24, round(path.length_m / spacing_m))
    s = np.arange(count, dtype=np.float64) * (path.length_m / count)
    xy, psi, kappa, v, a = path.at(s + _start(track, path))
    psi = psi - 2 * np.pi * np.round(psi[0] / (2 * np.pi))
    return RaceLine(track.name, s, xy[:, 0], xy[:, 1], psi, kappa, v, a, path.length_m)


def _start(track: Track, path: Clothoids) -> float:
    """Arc length, in [0, length), from station 0 to the start line.

    The frame is smoothed, so its station 0 and the start line differ slightly.
    """
    line = StartLine(track)
    s = 0.0
    for _ in range(20):
        xy, *_ = path.at(np.array([s % path.length_m]))
        change = line.signed_distance(float(xy[0, 0]), float(xy[0, 1]))
        s -= change
        if abs(change) < 1e-12:
            break
    return s % path.length_m
