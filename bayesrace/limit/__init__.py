"""The limit: the fastest lap that a car can drive on a track, by minimum-time optimal control.

With the true model, tyres and actuators' limits as the plant has them; grid, first guess and IPOPT
are the racing line's (:mod:`bayesrace.raceline`). Order: the racing line on the gates (guess.py),
the nonlinear programme (ocp.py, of pieces as programme.py has them; outline.py for the car's
outline), solved on meshes twice as fine each (solve.py), and the lap as a file (lap.py), kept in
the cache (cached.py).

CasADi is imported on the first call of :func:`compute_limit`, not with this package.
"""

from bayesrace.limit.lap import LimitLap, LimitSettings, read_limit, write_limit
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["LimitLap", "LimitSettings", "compute_limit", "read_limit", "write_limit"]


def compute_limit(
    track: Track, car: CarParameters, settings: LimitSettings | None = None
) -> LimitLap:
    """The fastest lap of ``car`` on ``track``; see :mod:`bayesrace.limit.solve`.

    Raises InputError when the margin leaves no room or no lap is found.
    """
    from bayesrace.limit.solve import solve

    return solve(track, car, settings or LimitSettings())
