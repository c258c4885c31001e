"""Samples of a learning job's folder: driven, kept from lap to lap, each learned from once.

Training number K reads what was kept before it, ``kept-(K-1).npz``, and what is new, ``new-K.npz``,
and leaves ``kept-K.npz``: a bounded part of both, whole or not at all. The appearance of that file
turns new samples into kept ones, so that after a kill at any moment they are one or the other.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import clear_partials, replacing
from bayesrace.vehicles.parameters import CarParameters
from learning.arrays import dataset_from_npz, write_npz
from learning.dataset import Dataset, concatenate
from learning.pool import MOST_NEW
from learning.subset import evenly

__all__ = ["Batch", "SampleStore"]

_FILE: Final = re.compile(r"(kept|new)-(\d+)\.npz")


@dataclass(frozen=True)
class Batch:
    """Files of one training."""

    old: Path | None
    """Kept before; None if nothing was."""
    new: Path
    kept: Path
    """To be written."""


class SampleStore:
    """What was found in the folder waits to be learned from; so does what is added."""

    def __init__(self, folder: Path, car: CarParameters) -> None:
        """Clears away what a killed job has left over. InputError if a file is damaged."""
        self._folder = folder
        # New samples tell the number, too, where somebody has deleted damaged ones that were kept.
        numbers = (n if kind == "kept" else n - 1 for _, kind, n in self._files())
        self._trained = max(numbers, default=0)
        """Number of the last training that has kept samples."""
        self._tidy()
        if self.kept is not None:  # else every training to come would fail over it
            _read(self.kept, car)
        new = self._file("new", self._trained + 1)
        self._waiting = _read(new, car) if new.exists() else None
        self._taken: Dataset | None = None
        """By the training under way."""

    @property
    def waiting(self) -> bool:
        """There are samples that no training has taken."""
        return self._waiting is not None

    @property
    def kept(self) -> Path | None:
        """Samples that the last training has kept."""
        path = self._file("kept", self._trained)
        return path if path.exists() else None

    def add(self, samples: Dataset) -> None:
        """More samples; of more than may come at once, some are left out."""
        if len(samples):
            self._waiting = _joined([self._waiting, samples])

    def clear(self) -> None:
        """Forgets and deletes everything."""
        for path, _, _ in self._files():
            path.unlink()
        self._waiting, self._trained = None, 0

    def begin(self) -> Batch:
        """The files of a training of all samples that wait; ValueError if none do."""
        if self._waiting is None:
            raise ValueError("there is nothing to learn from")
        self.save()
        self._taken, self._waiting = self._waiting, None
        number = self._trained + 1
        return Batch(self.kept, self._file("new", number), self._file("kept", number))

    def end(self) -> None:
        """The training is over: what it has not kept waits for the next one."""
        taken, self._taken = self._taken, None
        if taken is None:
            return
        if self._file("kept", self._trained + 1).exists():
            self._trained += 1
            self._tidy()
        else:
            self._waiting = _joined([taken, self._waiting])

    def save(self) -> None:
        """Writes what waits, so that it is found again; not while a training is under way."""
        if self._waiting is not None:
            path = self._file("new", self._trained + 1)
            with replacing(path) as partial:
                write_npz(partial, self._waiting)

    def _file(self, kind: str, number: int) -> Path:
        return self._folder / f"{kind}-{number:04d}.npz"

    def _files(self) -> list[tuple[Path, str, int]]:
        """Whole files with their kind and number."""
        found = ((path, _FILE.fullmatch(path.name)) for path in self._folder.iterdir())
        return [(path, match[1], int(match[2])) for path, match in found if match]

    def _tidy(self) -> None:
        """Deletes what the last training has replaced, and files that were never finished."""
        for path, kind, number in self._files():
            if number < self._trained or (kind == "new" and number == self._trained):
                path.unlink()
        clear_partials(self._folder)


def _read(path: Path, car: CarParameters) -> Dataset:
    try:
        return dataset_from_npz(path, car)
    except InputError as error:
        raise InputError(
            f"{error}; delete it to go on without these samples, or choose another folder"
        ) from None


def _joined(datasets: Sequence[Dataset | None]) -> Dataset:
    """All samples in this order, or as many of them as may come at once."""
    every = concatenate([one for one in datasets if one is not None])
    return every.select(evenly(len(every), MOST_NEW), "too many at once")
