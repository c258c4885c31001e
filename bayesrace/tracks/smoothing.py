"""Smooth centrelines through points that were measured with noise."""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.tracks.spline import fit_arc_length

__all__ = ["smooth"]

_NODES_A_WIDTH: Final = 6
"""Nodes of the smooth centreline in a width of the track."""
_FEWEST: Final = 24
_STRENGTHS: Final = np.geomspace(1e-3, 1e13, 200)
"""Of the smoothing: a filter over a thirtieth of a point to a thousand points."""


def smooth(points: Floats, right: Floats, left: Floats) -> tuple[Floats, Floats, Floats]:
    """Evenly spaced points (m, 2) of a smooth closed curve along measured ones (n, 2) in driving
    order, and the widths (m,) there, linear between those given (n,).

    The periodic smoothing spline over the points' numbers, as a filter; how smooth it is follows
    from the points alone, by generalised cross-validation (Craven and Wahba 1979).
    """
    count = len(points)
    spectrum = np.fft.fft(points[:, 0] + 1j * points[:, 1])
    bend = (2 - 2 * np.cos(2 * np.pi * np.arange(count) / count)) ** 2
    gains = 1 / (1 + _STRENGTHS[:, None] * bend)
    rest = np.sum((1 - gains) ** 2 * np.abs(spectrum) ** 2, axis=1)
    best = int(np.argmin(rest / (count - gains.sum(axis=1)) ** 2))
    filtered = np.fft.ifft(gains[best] * spectrum)
    curve = fit_arc_length(np.column_stack([filtered.real, filtered.imag]))
    wanted = round(_NODES_A_WIDTH * curve.period / float(np.median(right + left)))
    nodes = min(count, max(wanted, _FEWEST))
    at = curve.knots[0] + np.arange(nodes) * (curve.period / nodes)
    knots = np.append(curve.knots, curve.knots[0] + curve.period)
    widths = (np.interp(at, knots, np.append(side, side[0])) for side in (right, left))
    return curve(at), *widths
