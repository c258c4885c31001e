"""The folder of a learning job: what was driven and learned, and enough to go on after an end.

================  ===============================================================================
file              what
================  ===============================================================================
settings.json     of the job (:class:`.settings.LearnSettings`)
laps.json         :class:`Record`: every lap, every update with the controller's answer
weights-NNNN.bin  weights learned after that lap (0000: from the data given); the newest ones
weights-given.bin weights that the job was given to begin with
kept-N.npz        samples kept so far, bounded (:mod:`.store`; form: :mod:`learning.arrays`)
new-N.npz         samples that no update has learned from yet
laps.png          lap time against lap number
worker.log        what the training processes of the last job have said besides
lock              held by the job that runs
================  ===============================================================================

Every file but the last two is replaced whole: whenever the job is killed, the folder can be gone on
with.
"""

import fcntl
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import IO, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import clear_partials, read_whole, write_whole
from experiments.learn.settings import LearnSettings

__all__ = ["MOST_WEIGHTS", "Journal", "LapRecord", "Record", "UpdateRecord"]

MOST_WEIGHTS: Final = 20
"""Weights files that stay, the newest; besides, those that are in use or were last accepted."""

_MOST_REMARKS: Final = 50
"""Each is there once, but some name a number."""

Verdict = Literal[
    "waiting", "accepted", "refused", "rolled back", "not sent", "no answer", "failed"
]
"""Of weights: ``waiting`` for a controller's answer; ``no answer``: newer weights came first; ``not
sent``: declined before; ``failed``: the training."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class LapRecord(_Frozen):
    """One lap that was driven."""

    lap: int = Field(description="number in this folder, from 1")
    run: int = Field(description="number of the run in all messages")
    time_s: float | None = Field(description="lap time; null if an end of it was not seen")
    flying: bool = Field(description="begun at speed, not from standstill")
    versions: list[str] = Field(description="of the weights that drove it, in order")
    samples: int = Field(description="fit to learn from")
    left_out: dict[str, int] = Field(description="samples left out, by reason")
    fallbacks: int = Field(description="cycles that the fallback drove")
    off_track_m: float | None = Field(description="deepest excursion; null without a track")


class UpdateRecord(_Frozen):
    """One training, and what became of its weights."""

    after_lap: int = Field(description="last lap that it learned from; 0: only the data given")
    version: str = Field("", description="of its weights; empty if there are none")
    file: str = Field("", description="of the weights; those of long ago are deleted")
    samples: int = Field(0, description="learned from")
    kept: int = Field(0, description="samples kept for the next time")
    points: int = Field(0, description="training points per output, the most")
    training_s: float = 0.0
    metrics: Mapping[str, Mapping[str, float]] = Field(
        default_factory=dict, description="held out, per output"
    )
    verdict: Verdict = "waiting"
    answer: str = Field("", description="in words")
    cycle: int | None = Field(None, description="of the controller, at which it took over")
    acceptance: int | None = Field(None, description="number of the takeover")


class Record(_Frozen):
    """``laps.json``."""

    schema_version: Literal[1] = 1
    recall: bool = Field(
        True, description="what the given weights know counts until samples are kept"
    )
    laps: list[LapRecord] = Field(default_factory=list)
    updates: list[UpdateRecord] = Field(default_factory=list)
    remarks: list[str] = Field(
        default_factory=list, description="why nothing could be learned from a drive, each once"
    )


class _Files:
    settings: Final = "settings.json"
    record: Final = "laps.json"
    given: Final = "weights-given.bin"
    plot: Final = "laps.png"
    worker: Final = "worker.log"
    lock: Final = "lock"


class Journal:
    """The folder, opened by the one job that writes it, until :meth:`close`; ``with`` it."""

    FILES: Final = _Files

    def __init__(self, folder: Path, settings: LearnSettings) -> None:
        """Makes the folder, or goes on with what is in it.

        InputError if it holds a job of another car or discretisation, or something else, or if
        another job is at work in it.
        """
        self.folder = folder
        self.record = Record()
        path = folder / _Files.settings
        if folder.is_dir() and not path.exists() and _foreign(folder):
            raise InputError(f"{folder} holds something else; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder)
        try:
            self.resumed = self.resumable(folder)
            """There is something to go on with."""
            if path.exists():
                self._check(settings)
                self.record = self._read()
            write_whole(path, settings.model_dump_json(indent=1) + "\n")
            clear_partials(folder)  # of a killed job
        except BaseException:
            self.close()
            raise

    @staticmethod
    def resumable(folder: Path) -> bool:
        """A job that is given this folder goes on with what is in it."""
        return (folder / _Files.record).exists()

    @staticmethod
    def settings_in(folder: Path) -> LearnSettings:
        """Those of the job that has left this folder; InputError if none has."""
        path = folder / _Files.settings
        try:
            return LearnSettings.model_validate_json(read_whole(path, "the settings"))
        except (InputError, ValidationError):
            raise InputError(f"{path} is of no learning job; choose another folder") from None

    def close(self) -> None:
        """Another job may have the folder; nothing may be written after this."""
        self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def path(self, name: str) -> Path:
        """Of a file in the folder."""
        return self.folder / name

    def existing(self, name: str) -> Path | None:
        """Of a file if it is there."""
        path = self.path(name)
        return path if path.is_file() else None

    def begin(self, given: UpdateRecord | None, recall: bool) -> None:
        """From now on the folder is gone on with: what was given is in it."""
        updates = [] if given is None else [given]
        self._write(Record(recall=recall, updates=updates))

    def save(self) -> None:
        """Writes the record though nothing is new: what else is there will be gone on with."""
        self._write(self.record)

    def add_lap(self, lap: LapRecord) -> None:
        """One lap more."""
        self._write(self.record.model_copy(update={"laps": [*self.record.laps, lap]}))

    def add_update(self, update: UpdateRecord) -> None:
        """One update more; those before it do not wait for an answer any more."""
        before = [
            one.model_copy(update={"verdict": "no answer"}) if one.verdict == "waiting" else one
            for one in self.record.updates
        ]
        self._write(self.record.model_copy(update={"updates": [*before, update]}))

    def remark(self, text: str) -> None:
        """Notes it, unless it has been."""
        remarks = self.record.remarks
        if text not in remarks:
            newest = [*remarks, text][-_MOST_REMARKS:]
            self._write(self.record.model_copy(update={"remarks": newest}))

    def change_update(self, version: str, **changes: object) -> UpdateRecord | None:
        """Changes the last update of this version; None if there is none."""
        for index in range(len(self.record.updates) - 1, -1, -1):
            if self.record.updates[index].version == version:
                changed = self.record.updates[index].model_copy(update=changes)
                updates = [*self.record.updates]
                updates[index] = changed
                self._write(self.record.model_copy(update={"updates": updates}))
                return changed
        return None

    def update_of(self, version: str) -> UpdateRecord | None:
        """The last update of this version; None if it is somebody else's."""
        updates = (one for one in reversed(self.record.updates) if one.version == version)
        return next(updates, None) if version else None

    def last_accepted(self) -> UpdateRecord | None:
        """The newest update that the controller took and kept, if its file is there."""
        for one in reversed(self.record.updates):
            if one.verdict == "accepted" and self.existing(one.file) is not None:
                return one
        return None

    def declined(self, version: str) -> bool:
        """These weights were refused or rolled back: nobody wants them a second time."""
        verdicts = {one.verdict for one in self.record.updates if one.version == version}
        return bool(verdicts & {"refused", "rolled back"})

    def free_weights(self, lap: int) -> Path:
        """A file for the weights after this lap that no update has had."""
        taken = {one.file for one in self.record.updates}
        names = (f"weights-{lap:04d}{'' if k == 1 else f'-{k}'}.bin" for k in count(1))
        return self.path(next(name for name in names if name not in taken))

    def drop_weights(self, in_use: str) -> None:
        """Deletes weights files, but for the newest, those last accepted and those in use.

        ``in_use``: version that the controller drives with. Weights that a killed job has left
        without an update go as well, so call it only while no training is under way.
        """
        updates = [one for one in self.record.updates if one.file]
        needed = [*updates[-MOST_WEIGHTS:], self.last_accepted(), self.update_of(in_use)]
        names = {one.file for one in needed if one is not None}
        for path in self.folder.glob("weights-[0-9]*.bin"):
            if path.name not in names:
                path.unlink()

    def _check(self, settings: LearnSettings) -> None:
        before = self.settings_in(self.folder)
        for what in ("car", "name", "discretisation"):
            if getattr(before, what) != getattr(settings, what):
                raise InputError(
                    f"{self.folder} holds what was learned with another {what}; choose another "
                    "folder, or the same settings"
                )

    def _read(self) -> Record:
        path = self.path(_Files.record)
        if not path.exists():
            return Record()
        try:
            return Record.model_validate_json(read_whole(path, "the journal", 1 << 28))
        except ValidationError as error:
            raise InputError(
                f"{path} cannot be read ({faults_in(error)}); choose another folder"
            ) from None

    def _write(self, record: Record) -> None:
        self.record = record
        write_whole(self.path(_Files.record), record.model_dump_json(indent=1) + "\n")


def _foreign(folder: Path) -> bool:
    """There is something in it besides what a job that was killed at its very start leaves."""
    names = (path.name for path in folder.iterdir())
    return any(name != _Files.lock and not name.startswith(".settings.") for name in names)


def _locked(folder: Path) -> IO[bytes]:
    """Nobody else gets it before it is closed, by whatever end of this process.

    InputError if somebody has it.
    """
    lock = (folder / _Files.lock).open("wb")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise InputError(
            f"another learning job is at work in {folder}; end it first, or choose another folder"
        ) from None
    return lock
