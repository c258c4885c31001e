"""Datasets in plain arrays (``.npz``, made by ``numpy.savez``); nothing in them is executed.

=========== ================================== ====================================================
array       shape                              what
=========== ================================== ====================================================
``car``     text                               a built-in car's name, or all its values (JSON)
``step_s``  number                             sampling time [s]
either
``x``       (n, 7)                             states [x, y, psi, vx, vy, omega, delta] at the start
``u``       (n, 2)                             inputs [d, delta_rate] that acted during the step
``x_next``  (n, 7)                             states at its end; rows need not be consecutive
or
``states``  (n + 1, 7)                         one unbroken drive
``inputs``  (n, 2)
=========== ================================== ====================================================

SI units, psi unwrapped. Other arrays are refused: a misspelt name would be data that nobody reads.

Besides, the form in which the paper's code publishes its drives (:mod:`learning.published`) is
read: ``states`` (6 or 7, n + 1) and ``inputs`` (2, n), beside whatever else, but without ``car``.
"""

import os
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.vehicles import CarParameters, car_text, described_car
from learning.dataset import Dataset, dataset_from_arrays
from learning.published import is_published, published_drive

__all__ = ["MAX_BYTES", "car_of_npz", "dataset_from_npz", "write_npz"]

MAX_BYTES: Final = 1 << 30
"""Unpacked arrays larger than this are refused before they are read."""

_SAME_STEP_S: Final = 1e-9

_SAMPLES: Final = ("x", "u", "x_next")
_DRIVE: Final = ("states", "inputs")
_ABOUT: Final = ("car", "step_s")
_SCHEMA: Final = (
    "need 'car', 'step_s', and either 'x' (n, 7), 'u' (n, 2), 'x_next' (n, 7) or "
    "'states' (n + 1, 7), 'inputs' (n, 2)"
)


def dataset_from_npz(
    path: str | os.PathLike[str], car: CarParameters | None = None, step_s: float | None = None
) -> Dataset:
    """All samples of a file, unfiltered.

    ``car`` and ``step_s``: what they must be, if given; needed for the published form, which does
    not name them. InputError for anything else than the arrays above, pickled ones included.
    """
    arrays = _read(Path(path))
    try:
        if is_published(arrays):
            if car is None or step_s is None:
                raise InputError("the published form does not name its car and step; give both")
            return published_drive(arrays["states"], arrays["inputs"], car, step_s)
        dataset = _dataset(arrays)
        if car is not None and dataset.car != car:
            raise InputError(f"samples of the car '{dataset.car.name}', not of '{car.name}'")
        if step_s is not None and abs(dataset.step_s - step_s) > _SAME_STEP_S:
            raise InputError(f"samples {dataset.step_s:g} s apart, not {step_s:g} s")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    # The number that is meant: one of single precision could not be mixed with others.
    return dataset if step_s is None else replace(dataset, step_s=step_s)


def car_of_npz(path: str | os.PathLike[str]) -> CarParameters | None:
    """The car that a file describes; None if it describes none. InputError if it is no such file.

    Whether the samples are fit to be read is not looked at.
    """
    arrays = _read(Path(path), ("car",))
    try:
        return described_car(_text(arrays["car"])) if "car" in arrays else None
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Arrays by name, all or those of ``names`` that are there."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise InputError(f"{path}: more than {MAX_BYTES >> 20} MB; split it")
        with np.load(path, allow_pickle=False) as file:
            wanted = [name for name in file.files if names is None or name in names]
            return {name: np.asarray(file[name]) for name in wanted}
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except InputError:
        raise
    except Exception as error:  # of zipfile, zlib, lzma, numpy: whatever damage makes them say
        raise InputError(f"{path}: not arrays as numpy.savez writes them ({error})") from error


def _dataset(arrays: Mapping[str, NDArray[Any]]) -> Dataset:
    names = set(arrays) - set(_ABOUT)
    if not set(_ABOUT) <= set(arrays) or names not in (set(_SAMPLES), set(_DRIVE)):
        raise InputError(f"arrays {', '.join(sorted(arrays)) or 'none'}; {_SCHEMA}")
    car = described_car(_text(arrays["car"]))
    for name in sorted(names | {"step_s"}):
        if arrays[name].dtype.kind not in "fiu":
            raise InputError(f"'{name}' holds no numbers")
    step_s = float(arrays["step_s"]) if arrays["step_s"].shape == () else float("nan")
    if not 0 < step_s <= 1:
        raise InputError("'step_s' must be one number of seconds, above 0 and at most 1")
    if names == set(_DRIVE):
        return dataset_from_arrays(car, step_s, arrays["states"], arrays["inputs"])
    return Dataset(car, step_s, arrays["x"], arrays["u"], arrays["x_next"])


def _text(array: NDArray[Any]) -> str:
    if array.shape != () or array.dtype.kind != "U":
        raise InputError("'car' must be one text")
    return str(array)


def write_npz(path: str | os.PathLike[str], dataset: Dataset) -> None:
    """The samples as :func:`dataset_from_npz` reads them."""
    np.savez_compressed(
        path,
        car=np.array(car_text(dataset.car)),
        step_s=np.array(dataset.step_s),
        x=dataset.x,
        u=dataset.u,
        x_next=dataset.x_next,
    )
