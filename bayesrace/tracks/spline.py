"""Periodic cubic splines of a closed plane curve over its own arc length, in numpy alone.

scipy has them too, but importing it costs more than loading a track, and the controller process
must start fast.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats

__all__ = ["Floats", "PlaneSpline", "fit_arc_length"]


_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True, eq=False)
class PlaneSpline:
    """C2 periodic interpolating cubic spline through ``points`` at ascending ``knots``.

    ``knots`` (n,) start anywhere, ``points`` (n, 2); after ``period`` the curve repeats, so the
    first point is not given twice.
    """

    knots: Floats
    points: Floats
    period: float

    @cached_property
    def _table(self) -> Floats:
        """Power coefficients (4, n, 2): point = c0 + c1 t + c2 t^2 + c3 t^3, t from the knot."""
        step = np.diff(np.append(self.knots, self.knots[0] + self.period))
        following = np.roll(self.points, -1, axis=0)
        slope = (following - self.points) / step[:, None]
        second = _cyclic_second_derivatives(step, 6.0 * (slope - np.roll(slope, 1, axis=0)))
        second_following = np.roll(second, -1, axis=0)
        width = step[:, None]
        return np.stack(
            [
                self.points,
                slope - width * (2.0 * second + second_following) / 6.0,
                second / 2.0,
                (second_following - second) / (6.0 * width),
            ]
        )

    def __call__(self, s: npt.ArrayLike, derivative: int = 0) -> Floats:
        """Point (..., 2), or its first or second derivative, at any real ``s`` (...)."""
        local, piece = self._locate(np.asarray(s, dtype=float))
        c0, c1, c2, c3 = self._table[:, piece]
        t = local[..., None]
        if derivative == 0:
            value = c0 + t * (c1 + t * (c2 + t * c3))
        elif derivative == 1:
            value = c1 + t * (2.0 * c2 + t * 3.0 * c3)
        else:
            value = 2.0 * c2 + 6.0 * t * c3
        return np.asarray(value)

    def derivatives(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Point, first and second derivative in one look-up."""
        local, piece = self._locate(s)
        c0, c1, c2, c3 = self._table[:, piece]
        t = local[..., None]
        return (
            c0 + t * (c1 + t * (c2 + t * c3)),
            c1 + t * (2.0 * c2 + t * 3.0 * c3),
            2.0 * c2 + 6.0 * t * c3,
        )

    def piece_lengths(self) -> Floats:
        """Arc length of each of the n pieces (5-point Gauss quadrature)."""
        step = np.diff(np.append(self.knots, self.knots[0] + self.period))
        at = self.knots[:, None] + step[:, None] * (_GAUSS_X + 1.0) / 2.0
        speed = np.linalg.norm(self(at, 1), axis=-1)
        return np.asarray(speed @ _GAUSS_W * step / 2.0)

    def _locate(self, s: Floats) -> tuple[Floats, npt.NDArray[np.intp]]:
        offset = np.mod(s - self.knots[0], self.period)
        piece = np.searchsorted(self.knots - self.knots[0], offset, side="right") - 1
        return offset - (self.knots[piece] - self.knots[0]), piece


def fit_arc_length(points: Floats) -> PlaneSpline:
    """Periodic spline through ``points`` (n, 2), not repeated, whose parameter is arc length.

    Starts from chord lengths; refitting over the measured arc lengths converges in few rounds
    (the remaining error is that of the spline's own speed between knots).
    """
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    for _ in range(4):
        knots = np.concatenate([[0.0], np.cumsum(lengths[:-1])])
        spline = PlaneSpline(knots, points, float(lengths.sum()))
        lengths = spline.piece_lengths()
    return spline


def _cyclic_second_derivatives(step: Floats, rhs: Floats) -> Floats:
    """Solves h_{i-1} M_{i-1} + 2 (h_{i-1} + h_i) M_i + h_i M_{i+1} = rhs_i, indices cyclic.

    Sherman-Morrison turns the cyclic system into two tridiagonal ones, solved by Thomas'
    algorithm on plain floats (faster than numpy scalars).
    """
    count = len(step)
    before = np.roll(step, 1)
    diagonal = 2.0 * (before + step)
    corner = float(before[0])  # couples the first with the last unknown
    gamma = -float(diagonal[0])
    diagonal[0] -= gamma
    diagonal[-1] -= corner * corner / gamma
    u = np.zeros(count)
    u[0], u[-1] = gamma, corner
    y, z = _tridiagonal(step[:-1], diagonal, np.column_stack([rhs, u]))
    ratio = corner / gamma
    factor = (y[0] + ratio * y[-1]) / (1.0 + z[0] + ratio * z[-1])
    return np.asarray(y - z[:, None] * factor)


def _tridiagonal(off: Floats, diagonal: Floats, rhs: Floats) -> tuple[Floats, Floats]:
    """Symmetric tridiagonal solve; the last column of ``rhs`` is returned apart."""
    count = len(diagonal)
    e, d = off.tolist(), diagonal.tolist()
    columns = []
    factors = [0.0] * count
    for i in range(1, count):
        factors[i] = e[i - 1] / d[i - 1]
        d[i] -= factors[i] * e[i - 1]
    for column in rhs.T.tolist():
        for i in range(1, count):
            column[i] -= factors[i] * column[i - 1]
        column[-1] /= d[-1]
        for i in range(count - 2, -1, -1):
            column[i] = (column[i] - e[i] * column[i + 1]) / d[i]
        columns.append(column)
    solution = np.array(columns).T
    return solution[:, :-1], solution[:, -1]
