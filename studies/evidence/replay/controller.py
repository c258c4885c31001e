"""By what a recorded drive is answered again: the controller that drove it, or another."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

from bayesrace.cache import cache_folder
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import (
    PredictiveController,
    compiled_controller,
    read_settings,
)
from bayesrace.controller.settings import CycleSettings, MpcSettings
from bayesrace.errors import InputError
from bayesrace.files import read_text
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.manifest import MANIFEST, read_manifest
from bayesrace.operation.preparation import model_artefact, progress_artefact
from bayesrace.operation.settings import RaceSettings
from bayesrace.raceline import RaceLine, racing_line, read_raceline_for
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import Car, get_car

__all__ = ["Given", "Host", "Setup", "set_up"]

Host = Literal["python", "c", "fmu"]

_MANIFESTS: Final = {"bestcase": "dynamic", "bayesrace-limit": "progress"}
"""Of a race's controllers; of all others: e_kinematic."""


@dataclass(frozen=True)
class Given:
    """What the command is given in place of what drove; empty or None: that."""

    controller: Path | None = None
    weights: Path | None = None
    host: Host = "python"
    car: str = ""
    track: str = ""
    raceline: Path | None = None
    mpc: Path | None = None

    @property
    def same(self) -> bool:
        """Controller and weights are to be those that drove."""
        return self.controller is None and self.weights is None and self.mpc is None


@dataclass(frozen=True, eq=False)
class Setup:
    """What answers the cycles of one controller process."""

    given: Given
    artefact: Path
    car: Car
    track: Track
    line: RaceLine
    mpc: MpcSettings
    same: bool
    """It is the controller that was recorded, as far as the files beside the log say."""
    folder: Path
    """Of the log."""

    def controller(self, version: str) -> PredictiveController:
        """Ready to drive with these weights."""
        return compiled_controller(
            self.artefact, self.car, self.track, self.line, self.weights(version), self.mpc
        )

    @property
    def cycle(self) -> CycleSettings:
        """Those of ``bayesrace controller``."""
        return CycleSettings()

    def weights(self, version: str) -> Weights | None:
        """Those in place of the recorded ones of that version; InputError if they are nowhere."""
        if self.given.weights is not None:
            return read_weights(self.given.weights)
        if not version:
            return None
        while version not in self._known:
            if (one := next(self._found, None)) is None:
                raise InputError(
                    f"no weights of version {version} beside the log in {self.folder}: put their "
                    "file there, or name the weights to drive with by --weights"
                )
            self._known[one.version] = one
        return self._known[version]

    @cached_property
    def _known(self) -> dict[str, Weights]:
        return {}

    @cached_property
    def _found(self) -> Iterator[Weights]:
        """All that are beside the log or in the cache."""
        for file in (*self.folder.glob("*.bin"), *cache_folder().glob("weights-*.bin")):
            with suppress(InputError):  # another file's business
                yield read_weights(file)


def set_up(log: Path, driven: Car | None, controller: str, given: Given) -> Setup:
    """For the log of that ``controller`` of a race, empty if it is of another recording: from the
    car that it names, if any, the files beside it, and what is given. InputError if something is
    missing."""
    folder = log.parent
    race = _race(folder) if controller else None
    car = get_car(given.car) if given.car else driven or _car(folder)
    track = _track(folder, given, car)
    line_file = given.raceline or _first(folder, "race_raceline.csv", "raceline.csv")
    line = read_raceline_for(line_file, track, car) if line_file else racing_line(track, car)
    mpc = read_settings(given.mpc or _first(folder, "mpc.json"), MpcSettings)
    artefact, same = given.controller, given.same
    if artefact is None and race is not None:
        artefact, same = _raced(folder, controller, race, same)
    elif artefact is None:
        artefact, _ = build(BuildSettings(car=car))
    read_manifest(artefact).check_car(car, artefact)
    return Setup(given, artefact, car, track, line, mpc, same, folder)


def _raced(folder: Path, controller: str, race: RaceSettings, same: bool) -> tuple[Path, bool]:
    """The artefact of a race's controller, and whether it is the recorded one to the bit."""
    named = _MANIFESTS.get(controller, "e_kinematic")
    if named == "progress":
        artefact = progress_artefact(race)
    else:
        artefact = model_artefact(race, "dynamic" if named == "dynamic" else "e_kinematic")
    recorded = _first(folder, f"manifest-{named}.json")
    if recorded is not None:
        same &= read_text(recorded, "the manifest", "") == (artefact / MANIFEST).read_text()
    return artefact, same


def _first(folder: Path, *names: str) -> Path | None:
    return next((folder / one for one in names if (folder / one).is_file()), None)


def _race(folder: Path) -> RaceSettings | None:
    settings = _first(folder, "settings.json")
    return None if settings is None else read_settings(settings, RaceSettings)


def _car(folder: Path) -> Car:
    file = _first(folder, "car.toml")
    if file is None:
        raise InputError(f"no file in {folder} says which car it is: name it with --car")
    return get_car(str(file))


def _track(folder: Path, given: Given, car: Car) -> Track:
    file = given.track or _first(folder, "race.csv", "track.csv")
    if not file:
        raise InputError(f"no track.csv in {folder}: name the track with --track")
    return load_track(file, car.width_m)
