"""Gates: lines across the track, in driving order, that a lap passes one after the other.

They are normals of a smoothed centreline and end at the edges of the real track. No two of them
cross on the track, so that a lap passes them in their order wherever it is driven. Nothing divides
by their distance: where they nearly meet, on the inside of a hairpin, a car passes them at once.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.frame import frame_at
from bayesrace.tracks import StartLine, Track
from bayesrace.tracks.spline import PlaneSpline
from bayesrace.vehicles.tuning import RacelineTuning

__all__ = ["Gates", "flying_gates", "standing_gates"]

_FOLD: Final = 0.98
"""Largest offset of a gate over the centreline's radius; at 1 neighbouring gates meet."""

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
    n_min_m: Floats
    n_max_m: Floats
    closed: bool
    """A flying lap, whose last gate is the first again."""

    @property
    def intervals(self) -> int:
        """M."""
        return len(self.place_m) - 1

    def points(self, n: Floats) -> Floats:
        """Positions (M + 1, 2) at offsets (M + 1,)."""
        return self.xy_m + n[:, None] * self.normal


def flying_gates(
    track: Track, curve: PlaneSpline, places: Floats, tuning: RacelineTuning, margin_m: float
) -> Gates:
    """Gates at ascending arc lengths (M + 1,) of the smoothed centreline, from 0 to its length.

    Raises InputError if the margin leaves no room somewhere.
    """
    frame = frame_at(places[:-1], curve, track, tuning, margin_m, _FOLD)

    def again(values: Floats) -> Floats:
        return np.concatenate([values, values[:1]])

    heading = again(frame.heading_rad)
    heading[-1] += frame.turn_rad.sum()
    return Gates(
        places,
        again(frame.xy_m),
        again(frame.normal),
        heading,
        again(frame.n_min_m),
        again(frame.n_max_m),
        closed=True,
    )


def standing_gates(
    track: Track, curve: PlaneSpline, places: Floats, tuning: RacelineTuning, margin_m: float
) -> Gates:
    """The same from the start pose, a gate without width, to the start line.

    Gates that the start line crosses are left out, as are those that are not ahead of the start.
    """
    gates = flying_gates(track, curve, places, tuning, margin_m)
    x, y, psi = track.start_pose()
    line, gap_m = StartLine(track), _CLOSEST * tuning.step_m
    ends = (gates.points(gates.n_min_m), gates.points(gates.n_max_m))
    past = np.max([[line.signed_distance(*xy) for xy in end.tolist()] for end in ends], axis=0)
    ahead = np.sum((gates.xy_m - (x, y)) * gates.normal[:, ::-1] * (1, -1), axis=1)
    reach = float(np.max(track.width_left_m + track.width_right_m))
    kept = (places > reach) | (ahead > gap_m)
    kept &= (places < curve.period - reach) | (past < -gap_m)
    kept[0] = kept[-1] = True
    psi += 2 * np.pi * np.round((gates.heading_rad[0] - psi) / (2 * np.pi))
    turn = gates.heading_rad[-1] - gates.heading_rad[0]
    gates.xy_m[[0, -1]] = x, y
    gates.normal[[0, -1]] = -np.sin(psi), np.cos(psi)
    gates.heading_rad[[0, -1]] = psi, psi + turn
    gates.n_min_m[[0, -1]] = 0.0, margin_m - track.width_right_m[0]
    gates.n_max_m[[0, -1]] = 0.0, track.width_left_m[0] - margin_m
    arrays = {one.name: getattr(gates, one.name)[kept] for one in fields(Gates)[:-1]}
    return Gates(**arrays, closed=False)
