"""The folder of a learning job: what was driven and learned, and enough to go on after an end.

================  ===============================================================================
file              what
================  ===============================================================================
settings.json     of the job (:class:`.settings.LearnSettings`)
laps.json         :class:`Record`: every lap, every update with the controller's answer
weights-NNNN.bin  weights learned after that lap (0000: from the data given)
kept.npz          samples kept so far, bounded (form: :mod:`learning.arrays`)
new.npz           samples that no update has learned from yet
laps.png          lap time against lap number
================  ===============================================================================

Every file is replaced whole: whenever the job is killed, the folder can be gone on with.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import CarParameters
from experiments.learn.settings import LearnSettings
from learning.arrays import dataset_from_npz, write_npz
from learning.dataset import Dataset

__all__ = ["Journal", "LapRecord", "Record", "UpdateRecord"]

Verdict = Literal["waiting", "accepted", "refused", "rolled back", "not sent", "failed"]


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
    file: str = ""
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
    laps: list[LapRecord] = Field(default_factory=list)
    updates: list[UpdateRecord] = Field(default_factory=list)


class _Files:
    settings: Final = "settings.json"
    record: Final = "laps.json"
    kept: Final = "kept.npz"
    next_kept: Final = "kept-next.npz"
    new: Final = "new.npz"
    plot: Final = "laps.png"
    worker: Final = "worker.log"


class Journal:
    """The folder, opened by the one job that writes it."""

    FILES: Final = _Files

    def __init__(self, folder: Path, settings: LearnSettings) -> None:
        """Makes the folder, or goes on with what is in it.

        InputError if it holds a job of another car or discretisation, or something else.
        """
        self.folder = folder
        self.record = Record()
        path = folder / _Files.settings
        if path.exists():
            self._check(path, settings)
            self.record = self._read()
        elif folder.is_dir() and any(folder.iterdir()):
            raise InputError(f"{folder} holds something else; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        _replace(path, settings.model_dump_json(indent=1) + "\n")

    @property
    def resumed(self) -> bool:
        """There is something to go on with."""
        samples = self.existing(_Files.kept) or self.existing(_Files.new)
        return bool(self.record.laps or self.record.updates or samples)

    def path(self, name: str) -> Path:
        """Of a file in the folder."""
        return self.folder / name

    def existing(self, name: str) -> Path | None:
        """Of a file if it is there."""
        path = self.path(name)
        return path if path.is_file() else None

    def add_lap(self, lap: LapRecord) -> None:
        """One lap more."""
        self._write(self.record.model_copy(update={"laps": [*self.record.laps, lap]}))

    def add_update(self, update: UpdateRecord) -> None:
        """One update more."""
        self._write(self.record.model_copy(update={"updates": [*self.record.updates, update]}))

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

    def put_samples(self, name: str, samples: Dataset) -> Path:
        """Writes samples to a file of the folder, whole or not at all."""
        path = self.path(name)
        partial = path.with_name(f".{path.stem}.part.npz")
        write_npz(partial, samples)
        partial.replace(path)
        return path

    def samples(self, name: str, car: CarParameters) -> Dataset | None:
        """Samples of a file of the folder, if it is there."""
        path = self.existing(name)
        return None if path is None else dataset_from_npz(path, car)

    def _check(self, path: Path, settings: LearnSettings) -> None:
        try:
            before = LearnSettings.model_validate_json(path.read_text(encoding="utf-8"))
        except (ValueError, ValidationError):
            raise InputError(f"{path} is of no learning job; choose another folder") from None
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
            return Record.model_validate_json(path.read_text(encoding="utf-8"))
        except (ValueError, ValidationError) as error:
            raise InputError(f"{path} cannot be read ({error}); choose another folder") from None

    def _write(self, record: Record) -> None:
        self.record = record
        _replace(self.path(_Files.record), record.model_dump_json(indent=1) + "\n")


def _replace(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.part")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
