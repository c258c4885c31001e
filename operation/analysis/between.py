"""Where the car was between the samples of a log, each millisecond.

The built-in equations go through the same sub-steps again, from each logged state with the input
that acted: in lockstep these are the plant's own states. In real time an input may change within a
period, and its mean is what is logged; the car is then off by tenths of a millimetre.
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, Discretisation
from bayesrace.vehicles import CarParameters
from operation.analysis.laps import Trajectory

__all__ = ["positions_between"]

_SAME: Final = 0.05
"""Over the wheelbase: a car that is farther from the next sample after a period is another one."""

_AT_ONCE: Final = 1000
"""Samples; a hundred laps at once would take half a gigabyte."""


def positions_between(run: Trajectory, car: CarParameters) -> Floats | None:
    """Positions (n - 1, m, 2) at the ends of the m sub-steps after each of the n samples.

    None where the samples are not evenly spaced, or where they are not those of the built-in
    equations.
    """
    steps = np.round(np.diff(run.time_s) * PLANT_SUBSTEP_HZ).astype(int)
    if not len(steps) or steps.min() < 1 or np.ptp(steps):
        return None
    places = _integrated(run.x[:-1], run.u, car, int(steps[0]))
    missed = np.linalg.norm(places[:, -1] - run.x[1:, :2], axis=1)
    return None if missed.max() > _SAME * car.wheelbase_m else places


def _integrated(x: Floats, u: Floats, car: CarParameters, count: int) -> Floats:
    """Positions (n, count, 2) after each sub-step from states (n, 7) with inputs (n, 2)."""
    import casadi as ca

    from bayesrace.vehicles.models import dynamic

    model = dynamic(car)
    substep = Discretisation(scheme=PLANT_SCHEME, step_s=1 / PLANT_SUBSTEP_HZ, substeps=1)
    period = substep.for_any_car(model).mapaccum(count)
    numbers = ca.DM(np.array(model.parameters))
    places = np.empty((len(x), count, 2))
    for begin in range(0, len(x), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        starts, inputs = x[part], np.repeat(u[part], count, axis=0)
        after = period.map(len(starts))(
            starts.T, inputs.T, ca.repmat(numbers, 1, len(starts) * count)
        )
        places[part] = np.asarray(after)[:2].T.reshape(len(starts), count, 2)
    return places
