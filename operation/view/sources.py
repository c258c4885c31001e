"""Where the messages of a view come from: always logs, which may still be written."""

import math
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.log import Entry, LogReader
from bayesrace.log_parts import part_files, part_path
from bayesrace.operation.view.errors import StepErrors
from bayesrace.operation.view.runs import Runs, course
from bayesrace.raceline import RaceLine, read_raceline
from bayesrace.scene import Scene
from bayesrace.tracks import Track, builtin_tracks, load_track, read_track
from bayesrace.vehicles import Car, get_car, read_car

__all__ = ["Source", "all_updates", "driven_race", "race_logs", "run_source"]

_LOG: Final = "run.mcap"
_TRACK, _LINE, _CAR = "race.csv", "race_raceline.csv", "car.toml"
"""Of a race, in its folder."""
_FRESH_S: Final = 3.0
"""A log that was written to so short a time ago is that of a race that runs ..."""
_APART_S: Final = 60.0
"""... also by the clock of another machine, whose disk it is on, if that is ahead by less."""
_AT_ONCE: Final = 4_000
"""Messages of a log that are held at a time."""


@dataclass
class Source:
    """A log, or several, and what they were driven on."""

    log: Path | None
    """None where all of them join later."""
    track: Track | None = None
    line: RaceLine | None = None
    car: Car | None = None
    title: str = ""
    errors: StepErrors | None = None
    """Of a race, in whose folder its weights are."""

    def __post_init__(self) -> None:
        self.runs = Runs(self.track, self.line, self.errors)
        self._readers: dict[str, LogReader] = {}
        """By the car, or "" of the one log."""
        self.faults: dict[str, str] = {}
        """What cannot be shown, by the name of a car, or by "the log"."""
        if self.log is not None:
            self._file = _identity(self.log)
            self._readers[""] = LogReader(self.log)

    @property
    def fault(self) -> str:
        """What cannot be shown, and why; empty if there is nothing."""
        return "; ".join(self.faults.values())

    @property
    def replaced(self) -> bool:
        """Whether there is something else to show now in its place."""
        if self.log is None or (there := _identity(self.log)) is None:
            return False
        return there != self._file or self._readers[""].overwritten

    @property
    def written(self) -> bool:
        """Whether something is being added."""
        return any(_is_written(one.path) for one in self._readers.values())

    def course(self) -> Any:
        """The update that begins a page."""
        return course(self.track, self.line, self.car, self.title)

    def scene(self) -> Scene | None:
        """For viewers that draw one; None where the car is not known."""
        return Scene(self.car, self.track, self.line) if self.car else None

    def read(self) -> list[Entry[Any]]:
        """Takes in what has been added to the logs, or a part of it, and returns that."""
        entries = [one for log in self._readers.values() for one in islice(log.newer(), _AT_ONCE)]
        if len(self._readers) > 1:
            entries.sort(key=lambda one: one.wall_ns)
        self.runs.take(entries)
        if entries:
            self.faults.pop("the log", None)  # what seemed to be cut off goes on
        if refused := sum(one.refused for one in self._readers.values()):
            self.faults["the log"] = f"{refused} messages of the log cannot be read"
        return entries

    def read_all(self) -> None:
        """Takes in all of the logs, which are not written any more."""
        while self.read():
            pass
        self.runs.take((), whole=True)
        if any(one.truncated for one in self._readers.values()):
            self.faults["the log"] = "the log is cut off or damaged: what could be read is shown"


def all_updates(source: Source) -> list[Any]:
    """What a page is told that has nothing yet."""
    fault = [{"kind": "fault", "text": source.fault}] if source.fault else []
    return [source.course(), *source.runs.all_updates(), *fault]


def run_source(path: Path, track: str = "", car: str = "") -> Source:
    """The folder of a race, or a log alone, which is shown on ``track``, or on that which it names
    if that is built in, with the outline of ``car``. InputError if a file is missing."""
    if path.is_dir():
        if given := track or car:
            raise InputError(f"{path} is of a race, which has its own car and track; not '{given}'")
        raced, line = read_track(path / _TRACK), read_raceline(path / _LINE)
        own = read_car(path / _CAR)
        return Source(path / _LOG, raced, line, own, path.name, StepErrors(path, own))
    found = load_track(track) if track else None
    if found is None:
        named = LogReader(path).metadata().get("drive", {}).get("track", "")
        found = load_track(named) if named in builtin_tracks() else None
    title = f"{path.stem} · {found.name}" if found else path.stem
    return Source(path, found, None, get_car(car) if car else None, title)


def race_logs(folder: Path) -> list[Path]:
    """Logs of the races that have left their runs in a folder, the newest last; those of times
    to come, as a clock has it that was set since, are the older the later."""
    return sorted(folder.glob(f"*/{_LOG}"), key=lambda log: -abs(_age_s(log)))


def driven_race(folder: Path, than: Source | None = None) -> Source | None:
    """The race in a folder of runs whose log is being written; None if there is none, or only
    this one."""
    for log in race_logs(folder)[-1:]:
        other = than is None or than.log != log or than.replaced
        if other and _is_written(log):
            with suppress(InputError, OSError):
                return run_source(log.parent)
    return None


def _identity(log: Path) -> tuple[int, int] | None:
    """Of the file of that name; None if there is none."""
    with suppress(OSError):
        found = log.stat()
        return found.st_dev, found.st_ino
    return None


def _is_written(log: Path) -> bool:
    """Whether a log has been added to just now; of a car in the network, heartbeats are."""
    ages_s = [_age_s(part_path(log, number)) for number in part_files(log)]
    return any(-_APART_S < one < _FRESH_S for one in ages_s)


def _age_s(log: Path) -> float:
    """Since it was added to; negative by a clock that is ahead, or was set back since."""
    with suppress(OSError):
        return time.time() - log.stat().st_mtime
    return math.inf
