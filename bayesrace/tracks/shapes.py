"""Centrelines from corner points (straights joined by arcs, then eased into one another), and
smooth ones through points that were measured with noise."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.tracks.spline import fit_arc_length

__all__ = ["Corner", "resample_closed", "rounded_polygon", "smooth", "smooth_closed"]

Corner = tuple[float, float, float]
"""x [m], y [m] of a polygon's vertex and the radius [m] of the arc that rounds it."""

_NODES_A_WIDTH: Final = 6
"""Nodes of a smooth centreline in a width of the track."""
_FEWEST: Final = 24
_STRENGTHS: Final = np.geomspace(1e-3, 1e13, 200)
"""Of the smoothing: a filter over a thirtieth of a point to a thousand points."""


def rounded_polygon(
    corners: Sequence[Corner], spacing_m: float = 0.04, easing_m: float = 0.05
) -> Floats | None:
    """Points (n, 2), about ``spacing_m`` apart, along the closed polygon with rounded corners.

    Smoothing over ``easing_m`` lets the curvature grow over a short way instead of jumping where
    an arc begins. None if arcs overlap: the radii don't fit into the polygon.
    """
    vertices = np.array([corner[:2] for corner in corners])
    radii = np.array([corner[2] for corner in corners])
    edge = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(edge, axis=1)
    out = edge / length[:, None]
    into = np.roll(out, 1, axis=0)
    turn = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.sum(into * out, axis=1))
    tangent = radii * np.tan(np.abs(turn) / 2)
    if np.any(tangent + np.roll(tangent, -1) > length):
        return None
    dense = [
        _arc(vertices[i] - tangent[i] * into[i], into[i], turn[i], radii[i])
        for i in range(len(corners))
    ]
    points = resample_closed(np.concatenate(dense), 0.005)
    return resample_closed(smooth_closed(points, easing_m / 0.005), spacing_m)


def smooth_closed(points: Floats, sigma_samples: float) -> Floats:
    """Periodic Gaussian filter of evenly spaced points (n, 2); sigma counted in points."""
    frequency = 2 * np.pi * np.fft.rfftfreq(len(points))
    gain = np.exp(-0.5 * (sigma_samples * frequency) ** 2)
    spectrum = np.fft.rfft(points, axis=0) * gain[:, None]
    return np.asarray(np.fft.irfft(spectrum, len(points), axis=0))


def resample_closed(points: Floats, spacing_m: float) -> Floats:
    """Evenly spaced points on the closed polyline, starting at its first point."""
    closed = np.concatenate([points, points[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(8, round(float(s[-1]) / spacing_m))
    at = np.arange(count) * (s[-1] / count)
    return np.column_stack([np.interp(at, s, closed[:, 0]), np.interp(at, s, closed[:, 1])])


def _arc(start: Floats, direction: Floats, turn: float, radius: float) -> Floats:
    """Points from ``start`` along an arc that turns by ``turn`` [rad], a few mm apart."""
    count = max(2, int(np.ceil(abs(turn) * radius / 0.005)))
    angle = np.linspace(0.0, turn, count)
    left = np.array([-direction[1], direction[0]])
    sign = np.sign(turn) if turn else 1.0
    forward, sideways = radius * np.sin(np.abs(angle)), radius * (1 - np.cos(angle))
    return np.asarray(start + forward[:, None] * direction + sign * sideways[:, None] * left)


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
