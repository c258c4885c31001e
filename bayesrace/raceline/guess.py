"""The fastest speeds along a given path: first guess of the optimisation, lap of a fixed line."""

import math
from collections.abc import Callable

import numpy as np

from bayesrace.arrays import Floats

__all__ = ["speed_profile"]

_TABLE = 400


def speed_profile(
    kappa: Floats,
    step: Floats,
    grip_mps2: float,
    drive: Callable[[Floats], Floats],
    brake: Callable[[Floats], Floats],
    v_min: float,
    v_max: float,
    start_mps: float | None = None,
) -> Floats:
    """Speeds (n,) on a closed path of curvature ``kappa`` (n,), ``step`` (n,) to the next point.

    Forward-backward pass within the friction circle ``grip_mps2`` and the acceleration limits
    ``drive(v) >= a >= brake(v)``, starting at the slowest point so that the lap closes. With
    ``start_mps`` the path is open and begins at this speed; the last step is not used.
    """
    v = np.linspace(0.0, v_max, _TABLE)
    per_mps = (_TABLE - 1) / v_max
    highest, lowest = drive(v).tolist(), (-brake(v)).tolist()
    cap = np.clip(grip_mps2 / np.maximum(np.abs(kappa), 1e-6), v_min**2, v_max**2)
    start = int(np.argmin(cap)) if start_mps is None else 0
    energy: list[float] = np.roll(cap, -start).tolist()
    bend: list[float] = np.roll(np.abs(kappa), -start).tolist()
    length: list[float] = np.roll(step, -start).tolist()
    last = len(energy)
    if start_mps is not None:
        energy[0] = start_mps**2
        last -= 1

    def gained(k: int, limit: list[float]) -> float:
        """Most that the squared speed at k changes over a metre, by this table of speeds."""
        place = math.sqrt(energy[k]) * per_mps
        i = min(int(place), _TABLE - 2)
        along = grip_mps2**2 - (bend[k] * energy[k]) ** 2
        push = limit[i] + (place - i) * (limit[i + 1] - limit[i])
        return 2 * max(min(push, math.sqrt(max(along, 0.0))), 0.0)

    for k in range(last):
        following = (k + 1) % len(energy)
        energy[following] = min(energy[following], energy[k] + length[k] * gained(k, highest))
    for k in range(last - 1, -1, -1):
        following = (k + 1) % len(energy)
        energy[k] = min(energy[k], energy[following] + length[k] * gained(following, lowest))
    return np.asarray(np.sqrt(np.roll(energy, start)))
