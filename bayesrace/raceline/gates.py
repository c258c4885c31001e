"""Gates: lines across the track, in driving order, that a lap passes one after the other.

They are normals of a smoothed centreline and end at the edges of the real track. Both programmes of
minimum time, the racing line's and the limit's, have the offset on each gate as a variable.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks import StartLine, Track
from bayesrace.tracks.spline import PlaneSpline, fit_arc_length, resample_closed, smooth_closed
from bayesrace.vehicles.tuning import RacelineTuning

__all__ = [
    "Gates", "check_room", "even_places", "flying_gates", "smooth_centreline", "standing_gates",
]  # fmt: skip

_OVERSAMPLING: Final = 8

_CLOSEST: Final = 0.02
"""Least distance of a gate from the start line, over an interval of the racing line."""


@dataclass(frozen=True, eq=False)
class Gates:
    """M + 1 gates with M intervals in between; arrays (M + 1,) or (M + 1, 2).

    The point of gate k at the offset n is xy[k] + n normal[k].
    """

    place_m: Floats
    """Arc lengths on the smoothed centreline, ascending from 0 to its length."""
    xy_m: Floats
    normal: Floats
    """To the left of the driving direction."""
    heading_rad: Floats
    """Driving direction across the gate, continuous."""
    kappa_radpm: Floats
    """Of the smoothed centreline."""
    n_min_m: Floats
    n_max_m: Floats
    closed: bool = True
    """A flying lap, whose last gate is the first again."""

    @property
    def intervals(self) -> int:
        """M."""
        return len(self.place_m) - 1

    def points(self, n: Floats) -> Floats:
        """Positions (M + 1, 2) at offsets (M + 1,)."""
        return self.xy_m + n[:, None] * self.normal


def even_places(curve: PlaneSpline, track: Track, tuning: RacelineTuning) -> Floats:
    """Arc lengths (M + 1,) about ``tuning.step_m`` apart, from 0 to the curve's length."""
    count = _count(track, tuning)
    return np.append(np.arange(count) * (curve.period / count), curve.period)


def _count(track: Track, tuning: RacelineTuning) -> int:
    return max(24, round(track.length_m / tuning.step_m))


def smooth_centreline(track: Track, tuning: RacelineTuning) -> PlaneSpline:
    """The centreline without the noise of its points; it begins near the start line."""
    dense = _count(track, tuning) * _OVERSAMPLING
    points = track.position(np.arange(dense) * (track.length_m / dense))
    smooth = smooth_closed(points, tuning.smoothing_m * dense / track.length_m)
    return fit_arc_length(resample_closed(smooth, track.length_m / dense))


def flying_gates(
    track: Track,
    curve: PlaneSpline,
    places: Floats,
    tuning: RacelineTuning,
    margin_m: float,
    fold: float,
) -> Gates:
    """Gates at ascending arc lengths (M + 1,) of the smoothed centreline, from 0 to its length.

    ``fold``: largest offset over the centreline's radius; at 1 neighbouring gates meet. Raises
    InputError if the margin leaves no room somewhere.
    """
    room = track.width_left_m + track.width_right_m - 2 * margin_m
    check_room(track, track.s_m, room, margin_m, tuning.room_m)
    xy, first, second = curve.derivatives(places)
    tangent = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    kappa = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    n_max = _room(track, xy, normal, margin_m)
    n_min = -_room(track, xy, -normal, margin_m)
    with np.errstate(divide="ignore"):
        reach = fold / np.abs(kappa)
    n_max = np.where(kappa > 0, np.minimum(n_max, reach), n_max)
    n_min = np.where(kappa < 0, np.maximum(n_min, -reach), n_min)
    check_room(track, places, n_max - n_min, margin_m, tuning.room_m)
    return Gates(places, xy, normal, heading, kappa, n_min, n_max)


def check_room(track: Track, s: Floats, room: Floats, margin_m: float, least_m: float) -> None:
    """InputError if the margins on both sides leave less room (n,) than that at one of s (n,)."""
    tight = room < least_m
    if tight.any():
        at = float(s[int(np.argmax(tight))])
        raise InputError(
            f"track '{track.name}' is too narrow for a margin of {margin_m:.3g} m "
            f"near s = {at:.2f} m; choose a smaller margin"
        )


def _room(track: Track, xy: Floats, outward: Floats, margin_m: float) -> Floats:
    """How far one can go from each gate along ``outward`` until the margin to the edge."""
    reach = np.full(len(xy), float(np.mean(track.width_left_m + track.width_right_m)) / 2)
    for _ in range(20):
        excess = track.project_path(xy + reach[:, None] * outward, 0.0).off_track_m + margin_m
        reach = reach - excess
        if float(np.max(np.abs(excess))) < 1e-6:
            break
    return reach


def standing_gates(track: Track, gates: Gates, tuning: RacelineTuning, margin_m: float) -> Gates:
    """From the start pose, a gate without width, through those of a flying lap to the start line.

    Gates that the start line crosses are left out, as are those that are not ahead of the start.
    """
    x, y, psi = track.start_pose()
    line, gap_m, places = StartLine(track), _CLOSEST * tuning.step_m, gates.place_m
    ends = (gates.points(gates.n_min_m), gates.points(gates.n_max_m))
    past = np.max([line.signed_distance(*end.T) for end in ends], axis=0)
    ahead = np.sum((gates.xy_m - (x, y)) * gates.normal[:, ::-1] * (1, -1), axis=1)
    reach = float(np.max(track.width_left_m + track.width_right_m))
    kept = (places > reach) | (ahead > gap_m)
    kept &= (places < places[-1] - reach) | (past < -gap_m)
    kept[0] = kept[-1] = True
    psi += 2 * np.pi * np.round((gates.heading_rad[0] - psi) / (2 * np.pi))
    arrays = {one.name: getattr(gates, one.name)[kept] for one in fields(Gates)[:-1]}
    gates = Gates(**arrays, closed=False)
    gates.xy_m[[0, -1]] = x, y
    gates.normal[[0, -1]] = -np.sin(psi), np.cos(psi)
    gates.heading_rad[[0, -1]] += psi - gates.heading_rad[0]
    gates.n_min_m[[0, -1]] = 0.0, margin_m - track.width_right_m[0]
    gates.n_max_m[[0, -1]] = 0.0, track.width_left_m[0] - margin_m
    return gates
