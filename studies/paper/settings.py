"""What ``bayesrace paper`` is made from."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.defaults import Option
from bayesrace.errors import InputError
from bayesrace.files import read_text
from bayesrace.operation.settings import RaceSettings
from bayesrace.raceline import RaceLineSettings

__all__ = ["DRIVES", "LINE", "PaperSettings"]

_TRACKS: Final = "ethzmobil.csv", "ethz.csv"
"""Training and race track of the paper's 1:43 car."""
_TENTH_TRACK: Final = "f110_map2.csv"
"""Track of appendix B, which may be missing."""
LINE: Final = "ethz_published_raceline.csv"
"""The line that the paper's laps follow, which may be missing; closed, it is written beside the
page as a racing line of ours."""
DRIVES: Final = "DYN-PP-ETHZMobil.npz", "DYN-GPMPC-ETHZ.npz", "DYN-NMPC-ETHZ.npz"
"""Published drives: pure pursuit, BayesRace's lap, BestCase's lap."""


class PaperSettings(BaseModel):
    """What to reproduce the paper from; InputError for missing files."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    path = Path(__file__).with_name(f"{car}.json")
    settings: dict[str, Any] = json.loads(read_text(path, "the frozen settings"))
    return settings


def _files(folder: Path | None, names: Iterable[str], option: str) -> tuple[Path, ...]:
    """These files of the folder, none without a folder; InputError naming missing ones."""
    files = () if folder is None else tuple(folder / name for name in names)
    missing = ", ".join(path.name for path in files if not path.is_file())
    if missing:
        raise InputError(f"{option} {folder}: no {missing} there; docs/paper.md lists the files")
    return files
