"""The curvilinear frame of the optimisation: stations on a smoothed centreline.

Only the frame is smooth; the room to the left and right of each station is measured to the edges of
the real track.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks import Track
from bayesrace.tracks.shapes import resample_closed, smooth_closed
from bayesrace.tracks.spline import PlaneSpline, fit_arc_length
from bayesrace.vehicles.tuning import RacelineTuning

__all__ = ["Frame", "build_frame", "frame_at", "smooth_centreline"]

_FOLD: Final = 0.85
"""Largest n * kappa: beyond 1 neighbouring normals cross and stations lose their order."""

_OVERSAMPLING: Final = 8


@dataclass(frozen=True, eq=False)
class Frame:
    """N stations, arrays (N,): position of station k at offset n is xy[k] + n normal[k]."""

    xy_m: Floats
    normal: Floats
    heading_rad: Floats
    """Direction of the frame's tangent, continuous."""
    turn_rad: Floats
    """Heading of the next station minus that of this one; sums up to +-2 pi over the lap."""
    kappa_radpm: Floats
    n_min_m: Floats
    n_max_m: Floats
    length_m: float
    """Of the lap, or of a path that is not closed."""
    start_mps: float | None = None
    """Speed at the first station of a path that ends at the last one; None: a closed lap."""


def build_frame(track: Track, tuning: RacelineTuning, margin_m: float) -> Frame:
    """Stations about ``tuning.step_m`` apart; offsets keep ``margin_m`` from the track's edges.

    Raises InputError if the margin leaves no room somewhere.
    """
    curve = smooth_centreline(track, tuning)
    count = max(24, round(track.length_m / tuning.step_m))
    station = np.arange(count, dtype=np.float64) * (curve.period / count)
    return frame_at(station, curve, track, tuning, margin_m)


def smooth_centreline(track: Track, tuning: RacelineTuning) -> PlaneSpline:
    """The centreline without the noise of its points; it begins near the start line."""
    dense = max(24, round(track.length_m / tuning.step_m)) * _OVERSAMPLING
    points = track.position(np.arange(dense) * (track.length_m / dense))
    smooth = smooth_closed(points, tuning.smoothing_m * dense / track.length_m)
    return fit_arc_length(resample_closed(smooth, track.length_m / dense))


def frame_at(
    station: Floats,
    curve: PlaneSpline,
    track: Track,
    tuning: RacelineTuning,
    margin_m: float,
    fold: float = _FOLD,
) -> Frame:
    """Stations at ascending arc lengths (N,) of the curve; offsets up to ``fold`` times the radius.

    Raises InputError if the margin leaves no room somewhere.
    """
    room = track.width_left_m + track.width_right_m - 2 * margin_m
    _check_room(track, track.s_m, room, margin_m, tuning.room_m)
    xy, first, second = curve.derivatives(station)
    tangent = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    turn = np.diff(np.append(heading, heading[0]))
    turn[-1] = np.remainder(turn[-1] + np.pi, 2 * np.pi) - np.pi
    kappa = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    n_max = _room(track, xy, normal, margin_m)
    n_min = -_room(track, xy, -normal, margin_m)
    with np.errstate(divide="ignore"):
        reach = fold / np.abs(kappa)
    n_max = np.where(kappa > 0, np.minimum(n_max, reach), n_max)
    n_min = np.where(kappa < 0, np.maximum(n_min, -reach), n_min)
    _check_room(track, station, n_max - n_min, margin_m, tuning.room_m)
    return Frame(xy, normal, heading, turn, kappa, n_min, n_max, curve.period)


def _check_room(track: Track, s: Floats, room: Floats, margin_m: float, least_m: float) -> None:
    tight = room < least_m
    if tight.any():
        at = float(s[int(np.argmax(tight))])
        raise InputError(
            f"track '{track.name}' is too narrow for a margin of {margin_m:.3g} m "
            f"near s = {at:.2f} m; choose a smaller margin"
        )


def _room(track: Track, xy: Floats, outward: Floats, margin_m: float) -> Floats:
    """How far one can go from each station along ``outward`` until the margin to the edge."""
    reach = np.full(len(xy), float(np.mean(track.width_left_m + track.width_right_m)) / 2)
    for _ in range(20):
        excess = track.project_path(xy + reach[:, None] * outward, 0.0).off_track_m + margin_m
        reach = reach - excess
        if float(np.max(np.abs(excess))) < 1e-6:
            break
    return reach
