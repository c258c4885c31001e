"""Import of drives in the arrays that the paper's code publishes (``.npz``).

``states`` is (6, T + 1) or (7, T + 1): x, y, psi, vx, vy, omega and perhaps the steering angle;
``inputs`` is (2, T): duty cycle and **steering angle**. Nothing else in the file is read.

How the angle becomes (delta, delta_rate): the published plant holds inputs[1, k] during the whole
step k, while our cars turn the steering at a constant rate over the step, from delta_k to
delta_k + step * delta_rate. Both agree on where the steering is at the end of a step, so

    delta_k = inputs[1, k - 1]  (0 at the start),    delta_rate_k = (inputs[1, k] - delta_k) / step

which is also what the published seventh state and the published one-step predictions use. The
residual of such a drive contains, beside the model mismatch, the difference between a held and a
turning steering angle: fine for comparing with the paper, wrong for driving our cars.
"""

import os
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import CarParameters
from learning.dataset import Dataset, dataset_from_arrays

__all__ = ["read_published"]


def _arrays(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            states, inputs = (np.asarray(file[name], np.float64) for name in ("states", "inputs"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error}") from error
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: need numeric arrays 'states' and 'inputs' ({error})") from error
    return states, inputs


def read_published(path: str | os.PathLike[str], car: CarParameters, step_s: float) -> Dataset:
    """All samples of the drive, unfiltered; zero columns that pad its end are left out.

    The published pure-pursuit drive exceeds the car's limits on purpose or not; to learn from it
    for driving, pass the result through :func:`learning.dataset.filter_dataset`.
    """
    states, inputs = _arrays(Path(path))
    if (
        states.ndim != 2
        or states.shape[0] not in (6, 7)
        or inputs.shape
        != (
            2,
            states.shape[1] - 1,
        )
    ):
        raise InputError(
            f"{path}: states {states.shape} and inputs {inputs.shape} are not (6 or 7, T + 1) "
            "and (2, T)"
        )
    used = np.flatnonzero(states.any(axis=0))
    if len(used) < 2:
        raise InputError(f"{path}: fewer than two states that are not zero")
    end = int(used[-1]) + 1
    delta = np.concatenate(([0.0], inputs[1, : end - 1]))
    x = np.vstack((states[:6, :end], delta)).T
    u = np.column_stack((inputs[0, : end - 1], np.diff(delta) / step_s))
    return dataset_from_arrays(car, step_s, x, u)
