"""The car's outline within the track's edges, as constraints at the gates.

The outline is the car's rectangle with the centre of gravity in its middle. Each of some points
along it must keep the margin from the edge nearest to it. Which edge that is, and how it bends
there, is taken from a lap near the one that is sought, so that the lap is optimised again until
nothing changes. An edge is taken as an arc around the centreline's centre of curvature: the offset
of a point from an arc of the centreline is exact, and needs no foot point as a variable.
"""

from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.gates import Gates
from bayesrace.raceline.nlp import Indices, Piece
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["Outline"]

_ALONG: Final = 9
"""Points on each of the long sides, corners included."""


class Outline:
    """The outline of a car on a track."""

    def __init__(self, track: Track, car: CarParameters, margin_m: float) -> None:
        self._track, self._margin_m = track, margin_m
        self._near_m, self._smoothing_m = car.width_m, car.tuning.raceline.smoothing_m
        ahead = np.linspace(0.5, -0.5, _ALONG) * car.length_m
        aside = np.full(_ALONG, car.width_m / 2)
        self._points = np.concatenate(
            [np.column_stack([ahead, aside]), np.column_stack([ahead, -aside])]
        )
        """On the car, (2 x 9, 2): ahead and to the left of the centre of gravity."""

    def _placed(self, xy: Floats, psi: Floats) -> Floats:
        """The points of cars at positions (N, 2) and headings (N,), shape (18, N, 2)."""
        ahead, aside = self._points[:, 0, None], self._points[:, 1, None]
        cos, sin = np.cos(psi), np.sin(psi)
        return np.stack(
            [xy[:, 0] + ahead * cos - aside * sin, xy[:, 1] + ahead * sin + aside * cos], axis=-1
        )

    def beyond_m(self, xy: Floats, psi: Floats) -> float:
        """How far the cars reach into the margin; <= 0 for none."""
        feet = [self._track.project_path(one) for one in self._placed(xy, psi)]
        return self._margin_m + max(float(one.off_track_m.max()) for one in feet)

    def piece(
        self, gates: Gates, xy: Floats, psi: Floats, variables: Indices, scale: Floats
    ) -> Piece:
        """Constraints on points that are near an edge where the car is at the gates, (M + 1,).

        ``variables``: indices (N, 8) of the gates' in the programme; ``scale``: their sizes (8,).
        """
        count = len(variables)  # without the last gate where it is the first again
        xy, psi = xy[:count], psi[:count]
        rows, numbers, low, high = [], [], [], []
        for point, placed in zip(self._points, self._placed(xy, psi), strict=True):
            on = self._track.project_path(placed)
            near = np.flatnonzero(on.off_track_m > -self._margin_m - self._near_m)
            s = on.s_m[near]
            right, left = self._track.widths(s)
            rows.append(near)
            low.append(self._margin_m - right)
            high.append(left - self._margin_m)
            numbers.append(np.column_stack([
                gates.xy_m[near], gates.normal[near], np.tile(point, (len(near), 1)),
                self._track.position(s), self._track.heading(s), self._curvature(s),
            ]))  # fmt: skip
        w, p = ca.SX.sym("w", 2), ca.SX.sym("p", 10)
        return Piece(
            w=w,
            p=p,
            g=_offset(w * scale[:2], p) / scale[0],
            g_min=np.concatenate(low)[:, None] / scale[0],
            g_max=np.concatenate(high)[:, None] / scale[0],
            index=variables[np.concatenate(rows), :2],
            numbers=np.concatenate(numbers),
        )

    def _curvature(self, s: Floats) -> Floats:
        """Of the centreline, over a short way: its points may be noisy."""
        turned = self._track.heading(s + self._smoothing_m) - self._track.heading(
            s - self._smoothing_m
        )
        return np.asarray(np.angle(np.exp(1j * turned)) / (2 * self._smoothing_m))


def _offset(gate: Any, p: Any) -> Any:
    """Offset of a point on the car from the arc of the centreline that is nearest to it [m].

    ``gate``: offset and heading at a gate; p: the gate's point and normal, the point on the car,
    the arc's point, heading and curvature.
    """
    n, psi = gate[0], gate[1]
    ahead, aside, heading, kappa = p[4], p[5], p[8], p[9]
    cos, sin = ca.cos(psi), ca.sin(psi)
    dx = p[0] + n * p[2] + ahead * cos - aside * sin - p[6]
    dy = p[1] + n * p[3] + ahead * sin + aside * cos - p[7]
    along = dx * ca.cos(heading) + dy * ca.sin(heading)
    away = dy * ca.cos(heading) - dx * ca.sin(heading)
    radius = ca.sqrt((1 - kappa * away) ** 2 + (kappa * along) ** 2)
    return (2 * away - kappa * (along**2 + away**2)) / (1 + radius)
