"""Drives in the arrays that the paper's code publishes (``.npz``).

``states`` is (6, T + 1) or (7, T + 1): x, y, psi, vx, vy, omega and perhaps the steering angle;
``inputs`` is (2, T): duty cycle and **steering angle**. Nothing else in the file is looked at.

How the angle becomes (delta, delta_rate): the published plant holds inputs[1, k] during the whole
step k, while our cars turn the steering at a constant rate over the step, from delta_k to
delta_k + step * delta_rate. Both agree on where the steering is at the end of a step, so

    delta_k = inputs[1, k - 1]  (0 at the start),    delta_rate_k = (inputs[1, k] - delta_k) / step

which is also what the published seventh state and the published one-step predictions use. The
residual of such a drive contains, beside the model mismatch, the difference between a held and a
turning steering angle: fine for comparing with the paper, wrong for driving our cars.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import CarParameters
from learning.dataset import Dataset, dataset_from_arrays

__all__ = ["is_published", "published_drive"]


def is_published(arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Whether a file's arrays are such a drive. Ours name their car, and hold a sample a row."""
    if not {"states", "inputs"} <= set(arrays) or {"car", "step_s"} & set(arrays):
        return False
    states, inputs = arrays["states"].shape, arrays["inputs"].shape
    return len(states) == 2 and states[0] in (6, 7) and inputs == (2, states[1] - 1)


def published_drive(
    states: NDArray[Any], inputs: NDArray[Any], car: CarParameters, step_s: float
) -> Dataset:
    """All samples of the drive, unfiltered; zero columns that pad its end are left out.

    The published pure-pursuit drive exceeds the car's limits on purpose or not; to learn from it
    for driving, pass the result through :func:`learning.dataset.filter_dataset`. InputError for
    arrays that hold no numbers, or no drive.
    """
    for name, array in (("states", states), ("inputs", inputs)):
        if array.dtype.kind not in "fiu":
            raise InputError(f"'{name}' holds no numbers")
    used = np.flatnonzero(states.any(axis=0))
    if len(used) < 2:
        raise InputError("fewer than two states that are not zero")
    end = int(used[-1]) + 1
    delta = np.concatenate(([0.0], inputs[1, : end - 1]))
    x = np.vstack((states[:6, :end], delta)).T
    u = np.column_stack((inputs[0, : end - 1], np.diff(delta) / step_s))
    return dataset_from_arrays(car, step_s, x, u)
