"""First guess of the optimisation: the fastest drivable speeds along a given path."""

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
) -> Floats:
    """Speeds (n,) on a closed path of curvature ``kappa`` (n,), ``step`` (n,) to the next point.

    Forward-backward pass within the friction circle ``grip_mps2`` and the acceleration limits
    ``drive(v) >= a >= brake(v)``, starting at the slowest point so that the lap closes.
    """
    v = np.linspace(0.0, v_max, _TABLE)
    highest, lowest = drive(v), brake(v)
    cap = np.clip(grip_mps2 / np.maximum(np.abs(kappa), 1e-6), v_min**2, v_max**2)
    start = int(np.argmin(cap))
    energy = np.roll(cap, -start)
    bend = np.roll(np.abs(kappa), -start)
    length = np.roll(step, -start)
    count = len(energy)
    for k in range(count):
        room = _along(grip_mps2, bend[k] * energy[k])
        push = min(float(np.interp(np.sqrt(energy[k]), v, highest)), room)
        following = (k + 1) % count
        energy[following] = min(energy[following], energy[k] + 2 * length[k] * max(push, 0.0))
    for k in range(count - 1, -1, -1):
        following = (k + 1) % count
        room = _along(grip_mps2, bend[following] * energy[following])
        pull = min(-float(np.interp(np.sqrt(energy[following]), v, lowest)), room)
        energy[k] = min(energy[k], energy[following] + 2 * length[k] * max(pull, 0.0))
    return np.asarray(np.sqrt(np.roll(energy, start)))


def _along(grip: float, across: float) -> float:
    """What the friction circle leaves along the path beside the acceleration across it."""
    return float(np.sqrt(max(grip**2 - across**2, 0.0)))
