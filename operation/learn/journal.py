"""The folder of a learning job: ``laps.json``, ``samples.npz``, and the files made beside them.

``laps.json`` is the job's :class:`~.records.Record`. ``samples.npz`` holds the samples that the
next training learns from: those that the last one kept, and all driven since. Each file is replaced
as a whole, so a job that is killed at any moment leaves files that the next one can read.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import claimed, clear_partials, read_text, replacing, write_whole
from bayesrace.gp.weights import OUTPUTS, Weights, write_weights
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.sources import dataset_from_npz, write_npz
from bayesrace.learning.subset import MOST_NEW, evenly
from bayesrace.operation.learn.records import LapRecord, LearnSettings, Record, UpdateRecord

__all__ = ["MOST_WEIGHTS", "Journal", "resumable_settings"]

MOST_WEIGHTS: Final = 20
"""Weights files kept, the newest; besides, those that are in use or were last accepted."""

_RECORD: Final = "laps.json"
_SAMPLES: Final = "samples.npz"


class Journal:
    """The folder, locked against other jobs until :meth:`close`."""

    def __init__(self, folder: Path, settings: LearnSettings) -> None:
        """Makes the folder, or resumes the job in it.

        InputError if it holds a job of another car or discretisation, or something else, if its
        files are damaged, or if another job runs in the folder.
        """
        before = _read_record(folder)
        if (
            before is None
            and folder.is_dir()
            and any(not one.match(".*.part*") for one in folder.iterdir())
        ):
            raise InputError(f"{folder} holds something else; choose another folder")
        self._lock = ExitStack()
        self._lock.enter_context(claimed(folder))
        clear_partials(folder)
        self.folder, self.settings, self.resumed = folder, settings, before is not None
        self.record = before or Record()
        self._learning = self._new = Dataset(
            settings.car, settings.discretisation.step_s, *(np.empty((0, n)) for n in (7, 2, 7))
        )
        """Samples of the training that runs, or ran last; and those driven since it began."""
        self._unlearned = False
        """There are samples that no training has learned from to its end."""
        try:
            self._resume()
        except InputError:
            self.close()
            raise

    def _resume(self) -> None:
        settings, path = self.settings, self.folder / _SAMPLES
        was, self.record.settings = self.record.settings, settings
        for what in ("car", "name", "discretisation"):
            if was is not None and getattr(was, what) != getattr(settings, what):
                raise InputError(
                    f"{self.folder} holds what was learned with another {what}; choose another "
                    "folder, or the same settings"
                )
        if path.exists():
            try:
                self._new = dataset_from_npz(path, settings.car, settings.discretisation.step_s)
                trained = (one for one in reversed(self.record.updates) if one.verdict != "failed")
                kept = next((one.kept for one in trained), 0)
                self._unlearned = len(self._new) > kept
            except InputError as error:
                raise InputError(f"{error}; restore it, or choose another folder") from None
        self.save()

    def close(self) -> None:
        """Releases the folder; nothing may be written after this."""
        self._lock.close()

    @property
    def last_accepted(self) -> UpdateRecord | None:
        """The newest update that a controller took over and kept, if its file exists."""
        accepted = (one for one in reversed(self.record.updates) if one.verdict == "accepted")
        return next((one for one in accepted if (self.folder / one.file).is_file()), None)

    @property
    def initial(self) -> Path | None:
        """Weights to start the next training from; none after a failure, which may be theirs."""
        updates, best = self.record.updates, self.last_accepted
        failed = updates and updates[-1].verdict in ("refused", "rolled back", "failed")
        return None if best is None or failed else self.folder / best.file

    @property
    def newest(self) -> Path | None:
        """Weights of the samples that are kept, whatever a controller said of them."""
        made = (self.folder / one.file for one in reversed(self.record.updates) if one.file)
        newest = next(made, None)
        return newest if newest is not None and newest.is_file() else None

    def update_of(self, version: str) -> UpdateRecord | None:
        """The last update of this version; None if it is not one of this job's."""
        updates = (one for one in reversed(self.record.updates) if one.version == version)
        return next(updates, None) if version else None

    def add_driven(self, samples: Dataset | None, lap: LapRecord | None = None) -> None:
        """Adds samples, and the lap that ended with them, if one did, with its number."""
        if lap is not None:
            self.record.laps.append(lap)
            lap.lap = len(self.record.laps)
        if samples is not None:
            self._new = _joined(self._new, samples)
            self._unlearned |= len(samples) > 0
        if samples is not None or lap is not None:
            self.save(samples=samples is not None)

    def take_samples(self) -> Dataset | None:
        """For a training: all samples; None if none of them is new."""
        if not self._unlearned:
            return None
        self._learning, self._new = _joined(self._learning, self._new), self._new.select(slice(0))
        return self._learning

    def add_update(
        self, update: UpdateRecord, weights: Weights | None, kept: Dataset | None = None
    ) -> None:
        """Adds an update with its weights in a file; new weights supersede those still pending.

        ``kept``: what its training kept of the samples that it was given.
        """
        if weights is not None:
            for one in self.record.updates:
                one.verdict = "superseded" if one.verdict == "pending" else one.verdict
            update.version, update.points = weights.version, max(weights.counts)
            update.metrics = {name: weights.metrics.get(name, {}) for name in OUTPUTS}
            update.file = f"weights-{len(self.record.updates):04d}.bin"
            write_weights(self.folder / update.file, weights)
        self.record.updates.append(update)
        if kept is not None:
            update.kept = len(kept)
            self._learning, self._unlearned = kept, len(self._new) > 0
        self.save(samples=kept is not None)

    def remark(self, text: str) -> bool:
        """Notes why a drive gave nothing to learn from; False if that is noted already."""
        if text in self.record.remarks:
            return False
        self.record.remarks = [*self.record.remarks, text][-50:]  # some name a number
        self.save()
        return True

    def drop_weights(self, in_use: str) -> None:
        """Deletes old weights files, and those that a killed job has left without an update.

        ``in_use``: version that the controller drives with, which stays.
        """
        updates = [one for one in self.record.updates if one.file]
        needed = [*updates[-MOST_WEIGHTS:], self.last_accepted, self.update_of(in_use)]
        names = {one.file for one in needed if one is not None}
        for path in self.folder.glob("weights-*.bin"):
            if path.name not in names:
                path.unlink()

    def save(self, samples: bool = False) -> None:
        """Writes the record; ``samples``: and these before it."""
        try:
            if samples:
                with replacing(self.folder / _SAMPLES) as path:
                    write_npz(path, concatenate([self._learning, self._new]))
            write_whole(self.folder / _RECORD, self.record.model_dump_json(indent=1) + "\n")
        except OSError as error:
            why = f"cannot write in {self.folder}: {error.strerror or error}"
            raise InputError(f"{why}; the job can be resumed") from None


def resumable_settings(folder: Path) -> LearnSettings | None:
    """Settings of the job that a new one in this folder resumes; None if there is none.

    InputError if the record is damaged.
    """
    record = _read_record(folder)
    return None if record is None else record.settings


def _read_record(folder: Path) -> Record | None:
    path = folder / _RECORD
    if not path.exists():
        return None
    remedy = "restore it, or choose another folder"
    try:
        return Record.model_validate_json(read_text(path, "record", remedy))
    except ValidationError as error:
        raise InputError(f"{path} cannot be read ({faults_in(error)}); {remedy}") from None


def _joined(first: Dataset, second: Dataset) -> Dataset:
    """All samples in this order, or evenly spread ones where they are too many."""
    every = concatenate([first, second])
    return every.select(evenly(len(every), MOST_NEW))
