"""What ``bayesrace bench`` measures, ``paper`` reproduces and ``tune`` searches.

Kept apart from what does it, which takes seconds to import.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, ConfigDict, Field

from bayesrace.codegen.settings import ProblemName
from bayesrace.controller.settings import MpcSettings
from bayesrace.defaults import Option
from bayesrace.errors import InputError
from bayesrace.files import read_text
from bayesrace.operation.settings import PreparationSettings, RaceSettings
from bayesrace.raceline import RaceLineSettings
from bayesrace.strict import StrictModel
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import CarSetting, default_car

__all__ = [
    "DRIVES", "LINE", "PUBLISHED", "BenchSettings", "Case", "PaperSettings",
    "TuneSettings", "spread",
]  # fmt: skip

# The control step ------------------------------------------------------------------------------

Case = tuple[ProblemName, float]
"""Problem and caution."""

PUBLISHED: Final[Case] = ("tracking", 0.0)
"""What IPOPT solves: it knows no uncertainty."""


class BenchSettings(PreparationSettings):
    """What is measured."""

    tracks: Annotated[tuple[str, ...], Option("--track")] = Field(
        (),
        description="track to record problems on; empty: the car's race track, and two more with "
        "hairpins for the 1:43 car",
    )
    published: bool = Field(False, description="tracking without caution alone, as published")
    problems: int = Field(900, ge=10, description="control steps of a case, of all tracks")
    peers: int = Field(25, ge=1, description="number of them that IPOPT solves, too")

    @property
    def driven_on(self) -> tuple[str, ...]:
        """The tracks, in order; random ones are 1:43 circuits."""
        race = self.car.race_track
        more = ("random:11", "random:15") if race == DEFAULT_RACE_TRACK else ()
        return self.tracks or (race, *more)

    @property
    def cases(self) -> tuple[Case, ...]:
        """What is driven; not progress on linear tyres, which have no limit."""
        caution = MpcSettings().caution
        progress: tuple[Case, ...] = ("progress", caution), ("progress", 0.0)
        both: tuple[Case, ...] = ("tracking", caution), PUBLISHED
        if self.published:
            return (PUBLISHED,)
        return both + progress if self.car.has_limit else both


# The paper -------------------------------------------------------------------------------------

_TRACKS: Final = "ethzmobil.csv", "ethz.csv"
"""Training and race track of the paper's 1:43 car."""
_TENTH_TRACK: Final = "f110_map2.csv"
"""Track of appendix B, which may be missing."""
LINE: Final = "ethz_published_raceline.csv"
"""The line that the paper's laps follow, which may be missing; closed, it is written beside the
page as a racing line of ours."""
DRIVES: Final = "DYN-PP-ETHZMobil.npz", "DYN-GPMPC-ETHZ.npz", "DYN-NMPC-ETHZ.npz"
"""Published drives: pure pursuit, BayesRace's lap, BestCase's lap."""


class PaperSettings(StrictModel):
    """What to reproduce the paper from; InputError for missing files."""

    tracks: Annotated[Path | None, Option(metavar="DIR")] = Field(
        None,
        description="folder with ethz.csv and ethzmobil.csv, and f110_map2.csv and "
        "ethz_published_raceline.csv if you have them; None: built-in tracks",
    )
    data: Annotated[Path | None, Option(metavar="DIR")] = Field(
        None, description=f"folder of the published arrays {', '.join(DRIVES)}; None: none"
    )
    raceline: Path | None = Field(
        None,
        description="racing line that the 1:43 car drives, as 'bayesrace raceline' writes it; "
        "None: computed",
    )
    quick: bool = Field(False, description="fewer kernels, samples, seeds and problems")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of training drives and of the GPs")

    @property
    def drives(self) -> tuple[Path, ...]:
        """Files of the published drives; none without them."""
        return _files(self.data, DRIVES, "--data")

    @property
    def orca(self) -> RaceSettings:
        """Of the 1:43 car."""
        train, race = map(str, _files(self.tracks, _TRACKS, "--tracks") or ("", ""))
        return self._of("orca", train_track=train, track=race, line=self.raceline)

    @property
    def tenth(self) -> RaceSettings:
        """Of the 1:10 car; the paper's track is trained on, too.

        There the racing line assumes a friction of 1, as published.
        """
        race = (self.tracks or Path()) / _TENTH_TRACK
        if self.tracks is None or not race.is_file():
            return self._of("f1tenth")
        line = RaceLineSettings(friction=1.0)
        return self._of("f1tenth", train_track=str(race), track=str(race), raceline=line)

    @property
    def line(self) -> Path | None:
        """File of the published racing line, if there is one."""
        path = (self.tracks or Path()) / LINE
        return path if self.tracks is not None and path.is_file() else None

    def _of(self, car: str, **others: Any) -> RaceSettings:
        fewer: Any = {"kernels": ("matern25",), "points": 150} if self.quick else {}
        return RaceSettings.model_validate(
            _as_published(car) | {"seed": self.seed} | fewer | others
        )


def _as_published(car: str) -> dict[str, Any]:
    """Frozen settings of a race, the car's tuning included, by which the paper is reproduced.

    They hold every setting: a car's file and the defaults may change, the reproduction does not.
    As published there are no mirrored samples, no widened bands (``widen`` 1) and no caution.
    """
    path = Path(__file__).parent / "paper" / f"{car}.json"
    settings: dict[str, Any] = json.loads(read_text(path, "the frozen settings"))
    return settings


def _files(folder: Path | None, names: Iterable[str], option: str) -> tuple[Path, ...]:
    """These files of the folder, none without a folder; InputError naming missing ones."""
    files = () if folder is None else tuple(folder / name for name in names)
    missing = ", ".join(path.name for path in files if not path.is_file())
    if missing:
        raise InputError(f"{option} {folder}: no {missing} there; docs/paper.md lists the files")
    return files


# Tuning ----------------------------------------------------------------------------------------

_SPAN: Final = re.compile(r"(.*?)(\d{1,9})\.\.(\d{1,9})")


def spread(value: Any) -> list[Any]:
    """``TEXT A..B`` as TEXT with each number, or as numbers alone; all else as it is.

    Of more than a million numbers, one more than that.
    """
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return [value]
    text, first, last = match[1], int(match[2]), int(match[3])
    numbers = range(first, min(last, first + 1_000_000) + 1)
    return [f"{text}{number}" if text else number for number in numbers]


def _every(names: list[str]) -> tuple[str, ...]:
    return tuple(one for name in names for one in spread(name))


_Tracks = Annotated[tuple[str, ...], BeforeValidator(_every), Option(metavar="TRACK")]


class TuneSettings(StrictModel):
    """What is searched, and on which tracks."""

    model_config = ConfigDict(validate_default=True)

    car: CarSetting = Field(default_factory=default_car)
    track: _Tracks = Field(
        ("harbour", "random:21..24"),
        min_length=1,
        description="track to tune on: a name, random:SEED, random:FIRST..LAST; empty: harbour, "
        "random:21..24",
    )
    held_out: _Tracks = Field(
        ("random:31..36",),
        min_length=1,
        description="track that judges the result; empty: random:31..36",
    )
    trials: int = Field(60, ge=1, le=100_000, description="trials, the defaults included")
    batch: int = Field(4, ge=1, le=1000, description="trials that are proposed at once")
    seed: int = Field(0, ge=0, description="seed of the search")
