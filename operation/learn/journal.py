"""The folder of a learning job: ``learn.db``, and the files made beside it.

``learn.db`` (SQLite, one table of named contents) holds all that a job needs to resume: its
:class:`~.records.Record`, and its samples in three stages: ``new`` (driven since the last training
began), ``learning`` (taken by a training) and ``kept`` (by the last training that ended). Each
change is one transaction that is on the disk when it ends: after a kill or a power failure at any
moment every sample is in one stage.
"""

import sqlite3
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import clear_partials, write_whole
from bayesrace.gp.weights import OUTPUTS, GpWeights, write_weights
from learning.dataset import Dataset, concatenate
from learning.pool import MOST_NEW
from learning.subset import evenly
from operation.learn.records import LapRecord, LearnSettings, Record, UpdateRecord

__all__ = ["MOST_WEIGHTS", "Journal", "resumable_settings"]

MOST_WEIGHTS: Final = 20
"""Weights files kept, the newest; besides, those that are in use or were last accepted."""

_DATABASE: Final = "learn.db"
_SCHEMA: Final = """
    PRAGMA synchronous = FULL;
    PRAGMA locking_mode = EXCLUSIVE;
    BEGIN EXCLUSIVE;
    CREATE TABLE IF NOT EXISTS content (name TEXT PRIMARY KEY, data BLOB);
    COMMIT;
"""


class Journal:
    """The folder, locked against other jobs until :meth:`close`."""

    def __init__(self, folder: Path, settings: LearnSettings) -> None:
        """Makes the folder, or resumes the job in it.

        InputError if it holds a job of another car or discretisation, or something else, if the
        database is damaged, or if another job runs in the folder.
        """
        path = folder / _DATABASE
        if folder.is_dir() and not path.exists() and any(folder.iterdir()):
            raise InputError(f"{folder} holds something else; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        self._database, self.record, stages = _open(path)
        before, self.record.settings = self.record.settings, settings
        self.folder, self.settings, self.resumed = folder, settings, before is not None
        for what in ("car", "name", "discretisation"):
            if before is not None and getattr(before, what) != getattr(settings, what):
                self.close()
                raise InputError(
                    f"{folder} holds what was learned with another {what}; choose another folder, "
                    "or the same settings"
                )
        names = ("kept", "learning", "new")
        self._samples = {name: self._dataset(stages.get(name, b"")) for name in names}
        clear_partials(folder)
        if self.resumed:
            self.save()

    def close(self) -> None:
        """Releases the folder; nothing may be written after this."""
        self._database.close()

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

    def update_of(self, version: str) -> UpdateRecord | None:
        """The last update of this version; None if it is not one of this job's."""
        updates = (one for one in reversed(self.record.updates) if one.version == version)
        return next(updates, None) if version else None

    def add_driven(self, samples: Dataset | None, lap: LapRecord | None = None) -> None:
        """Adds samples, and the lap that ended with them, if one did, with its number."""
        if lap is not None:
            self.record.laps.append(lap)
            lap.lap = len(self.record.laps)
        if samples is not None or lap is not None:
            self.save(new=_joined(self._samples["new"], samples or self._dataset()))

    def take_samples(self) -> list[Dataset]:
        """For a training: the samples kept, and all others, which are in stage ``learning`` now."""
        learning = _joined(self._samples["learning"], self._samples["new"])
        if len(learning):
            self.save(learning=learning, new=self._dataset())
        return [self._samples["kept"], learning]

    def add_update(
        self, update: UpdateRecord, weights: GpWeights | None, **samples: Dataset
    ) -> None:
        """Adds an update with its weights in a file; new weights supersede those still pending.

        ``samples``: stages that change with it.
        """
        if weights is not None:
            for one in self.record.updates:
                one.verdict = "superseded" if one.verdict == "pending" else one.verdict
            update.version, update.points = weights.version, max(weights.counts)
            update.metrics = {name: weights.metrics.get(name, {}) for name in OUTPUTS}
            update.file = f"weights-{len(self.record.updates):04d}.bin"
            write_weights(self.folder / update.file, weights)
        self.record.updates.append(update)
        self.save(**samples)

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

    def save(self, **samples: Dataset) -> None:
        """Writes the record and these samples as one transaction, then ``laps.json``."""
        self._samples |= samples
        record = self.record.model_dump_json(indent=1) + "\n"
        content: dict[str, str | bytes] = {"record": record}
        for stage, data in samples.items():
            content[stage] = np.hstack((data.x, data.u, data.x_next)).astype("<f8").tobytes()
        try:
            with self._database as database:
                database.executemany("REPLACE INTO content VALUES (?, ?)", content.items())
        except sqlite3.Error as error:
            path = self.folder / _DATABASE
            raise InputError(f"cannot write {path}: {error}; the job can be resumed") from None
        write_whole(self.folder / "laps.json", record)

    def _dataset(self, data: bytes = b"") -> Dataset:
        x, u, x_next = np.split(np.frombuffer(data, "<f8").reshape(-1, 16), [7, 9], axis=1)
        return Dataset(self.settings.car, self.settings.discretisation.step_s, x, u, x_next)


def resumable_settings(folder: Path) -> LearnSettings | None:
    """Settings of the job that a new one in this folder resumes; None if there is none.

    InputError if the database is damaged, or if another job runs in the folder.
    """
    if not (folder / _DATABASE).is_file():
        return None
    database, record, _ = _open(folder / _DATABASE)
    database.close()
    return record.settings


def _open(path: Path) -> tuple[sqlite3.Connection, Record, dict[str, bytes]]:
    """The database, locked until it is closed, and the record and the samples in it."""
    database = sqlite3.connect(path, timeout=0)
    try:
        database.executescript(_SCHEMA)
        content: dict[str, Any] = dict(database.execute("SELECT name, data FROM content"))
        return database, Record.model_validate_json(content.pop("record", "{}")), content
    except (sqlite3.Error, ValidationError) as error:
        database.close()
        fault = faults_in(error) if isinstance(error, ValidationError) else error
        why = f"{path} cannot be read ({fault}); restore it"
        if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_BUSY:
            why = f"another learning job runs in {path.parent}; end it first"
        raise InputError(f"{why}, or choose another folder") from None


def _joined(first: Dataset, second: Dataset) -> Dataset:
    """All samples in this order, or evenly spread ones where they are too many."""
    every = concatenate([first, second])
    return every.select(evenly(len(every), MOST_NEW))
