"""Datasets in plain arrays (``.npz``, made by ``numpy.savez``); reading executes nothing.

A file holds ``car`` (a built-in name, or all values as JSON), ``step_s`` [s], and either single
samples, ``x`` (n, 7), ``u`` (n, 2), ``x_next`` (n, 7), or one unbroken drive, ``states``
(n + 1, 7), ``inputs`` (n, 2), as :class:`learning.dataset.Dataset` describes them. Any other array
is refused: it may be a misspelt one.

The published form, the drives of the paper's code, is read as well: ``states`` (6 or 7, n + 1),
their rates ``dstates``, ``inputs`` (2, n) with duty cycle and **steering angle**, any other arrays,
but no ``car``. Without ``dstates`` the published states are one-step predictions of a model, each
from a state of another file, and are refused. The published plant holds inputs[1, k] during the
whole step k, while our cars turn the steering at a constant rate, from delta_k to delta_k + step *
delta_rate. Both agree on the angle at the end of a step, so

    delta_k = inputs[1, k - 1]  (0 at the start),    delta_rate_k = (inputs[1, k] - delta_k) / step

which the published seventh state and one-step predictions use, too. The residual of such a drive
contains the difference between a held and a turning steering angle: fine for comparing with the
paper, wrong for driving our cars. Nor does that drive keep to the limits of the car.
"""

import os
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from bayesrace.arrays import AnyArray
from bayesrace.errors import InputError
from bayesrace.vehicles import CarParameters, car_text, described_car
from learning.dataset import Dataset, dataset_from_arrays

__all__ = ["MAX_BYTES", "car_of_npz", "dataset_from_npz", "write_npz"]

MAX_BYTES: Final = 1 << 30
"""Upper limit of the unpacked size; larger files are refused before they are read."""

_SAMPLES: Final = "x", "u", "x_next"
_DRIVE: Final = "states", "inputs"
_ABOUT: Final = {"car", "step_s"}
_SCHEMA: Final = (
    "need 'car', 'step_s', and either 'x' (n, 7), 'u' (n, 2), 'x_next' (n, 7) or "
    "'states' (n + 1, 7), 'inputs' (n, 2)"
)


def dataset_from_npz(
    path: str | os.PathLike[str], car: CarParameters | None = None, step_s: float | None = None
) -> Dataset:
    """All samples of a file, unfiltered.

    ``car`` and ``step_s``: the expected ones, if given; the published form, which names neither,
    needs both. InputError for any other content than the arrays above, pickled ones included.
    """
    arrays = _read(path)
    try:
        dataset = _dataset(arrays, car, step_s)
        if car is not None and dataset.car != car:
            raise InputError(f"samples of the car '{dataset.car.name}', not of '{car.name}'")
        if step_s is not None and abs(dataset.step_s - step_s) > 1e-9:
            raise InputError(f"samples {dataset.step_s:g} s apart, not {step_s:g} s")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    # A step in single precision becomes the number that is meant, so that samples can be mixed.
    return dataset if step_s is None else replace(dataset, step_s=step_s)


def car_of_npz(path: str | os.PathLike[str]) -> CarParameters | None:
    """The car that a file describes, its samples unchecked; None if it describes none.

    InputError if it is no such file.
    """
    arrays = _read(path, only="car")
    try:
        return _car(arrays) if arrays else None
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_npz(path: str | os.PathLike[str], dataset: Dataset) -> None:
    """The samples as :func:`dataset_from_npz` reads them."""
    car, step_s = np.array(car_text(dataset.car)), np.array(dataset.step_s)
    np.savez_compressed(
        path, car=car, step_s=step_s, x=dataset.x, u=dataset.u, x_next=dataset.x_next
    )


def _read(path: str | os.PathLike[str], only: str = "") -> dict[str, AnyArray]:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise InputError(f"{path}: more than {MAX_BYTES >> 20} MB; split it")
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files if only in ("", name)}
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except InputError:
        raise
    except Exception as error:  # damage raises anything of zipfile, zlib, lzma or numpy
        raise InputError(f"{path}: not arrays as numpy.savez writes them ({error})") from error


def _dataset(
    arrays: Mapping[str, AnyArray], car: CarParameters | None, step_s: float | None
) -> Dataset:
    names = set(arrays)
    for name in sorted(names & {*_SAMPLES, *_DRIVE, "step_s"}):
        if arrays[name].dtype.kind not in "fiu":
            raise InputError(f"'{name}' holds no numbers")
    if names >= {*_DRIVE} and not names & _ABOUT and _is_published(arrays):
        return _published(arrays, car, step_s)
    if names not in ({*_ABOUT, *_SAMPLES}, {*_ABOUT, *_DRIVE}):
        raise InputError(f"arrays {', '.join(sorted(names)) or 'none'}; {_SCHEMA}")
    own_step_s = arrays["step_s"]
    if own_step_s.shape != () or not 0 < own_step_s <= 1:
        raise InputError("'step_s' must be one number of seconds, above 0 and at most 1")
    own = _car(arrays), float(own_step_s)
    if "states" in names:
        return dataset_from_arrays(*own, *(arrays[name] for name in _DRIVE))
    return Dataset(*own, *(arrays[name] for name in _SAMPLES))


def _car(arrays: Mapping[str, AnyArray]) -> CarParameters:
    if arrays["car"].shape != () or arrays["car"].dtype.kind != "U":
        raise InputError("'car' must be one text")
    return described_car(str(arrays["car"]))


def _is_published(arrays: Mapping[str, AnyArray]) -> bool:
    states, inputs = arrays["states"].shape, arrays["inputs"].shape
    return len(states) == 2 and states[0] in (6, 7) and inputs == (2, states[1] - 1)


def _published(
    arrays: Mapping[str, AnyArray], car: CarParameters | None, step_s: float | None
) -> Dataset:
    """All samples of a published drive; zero columns that pad its end are left out."""
    if "dstates" not in arrays:
        raise InputError(
            "no 'dstates', so these are predictions of a model (the published KIN-*.npz) and "
            "not a drive: give the drive (DYN-*.npz)"
        )
    if car is None or step_s is None:
        raise InputError("the published form does not name its car and step; give both")
    states, inputs = arrays["states"], arrays["inputs"]
    used = np.flatnonzero(states.any(axis=0))
    if len(used) < 2:
        raise InputError("fewer than two states that are not zero")
    end = int(used[-1]) + 1
    delta = np.concatenate(([0.0], inputs[1, : end - 1]))
    x = np.vstack((states[:6, :end], delta)).T
    u = np.column_stack((inputs[0, : end - 1], np.diff(delta) / step_s))
    return dataset_from_arrays(car, step_s, x, u)
