"""One case of a campaign: settings, and who drives with them; as plain data where it travels."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bayesrace.cache import cache_folder, digest, software
from bayesrace.files import read_whole, write_whole
from bayesrace.operation.preparation import SOURCES
from bayesrace.operation.settings import RaceSettings
from bayesrace.vehicles import CarParameters

__all__ = ["CONTROLLERS", "LEARNS_FROM", "PAPER", "Case", "Controller", "Files", "car_identity"]
__all__ += ["factors", "software_identity"]

Controller = Literal[
    "worstcase", "bayesrace", "bayesrace-updated", "bayesrace-updated-twice", "bayesrace-limit",
    "bestcase",
]  # fmt: skip
CONTROLLERS: Final[tuple[Controller, ...]] = get_args(Controller)
PAPER: Final[tuple[Controller, ...]] = ("worstcase", "bayesrace", "bayesrace-updated", "bestcase")
LEARNS_FROM: Final[Mapping[Controller, tuple[Controller, ...]]] = {
    "bayesrace-updated": ("bayesrace",),
    "bayesrace-updated-twice": ("bayesrace", "bayesrace-updated"),
    "bayesrace-limit": ("bayesrace",),
}
"""Whose laps a controller's weights are learned from beside the training drive. Training begins
with the weights of the last one named."""

_FIXED: Final = {
    "mode", "fmu", "fmu_map", "simulator", "threads", "limit", "line", "discretisation.step_s",
    "pursuit.step_s", "pursuit.seed",
}  # fmt: skip
"""Settings that a campaign does not vary: it drives the built-in car in lockstep, in the plant's
period, and ``seed`` is the one seed."""

_LEFT_OUT: Final = {"car", "threads", "fmu", "fmu_map", "simulator", "line"}
"""Settings that a row has in other columns, or that no campaign has."""

_SOURCES: Final = (
    *SOURCES, "codegen", "codegen/problems", "operation/analysis/laps.py",
    "operation/preparation.py", "operation/settings.py", "studies/campaign/case.py",
    "studies/campaign/execute.py",
)  # fmt: skip
_PACKAGES: Final = ("casadi", "mcap", "numpy", "scipy")


@cache
def software_identity() -> str:
    """Digest of the code and the libraries that shape a result."""
    return digest(software(_SOURCES, _PACKAGES))


@cache
def factors() -> dict[str, FieldInfo]:
    """Every setting that a plan may vary, by its dotted name."""
    return {name: field for name, field in _fields(RaceSettings, "") if name not in _FIXED}


def _fields(form: type[BaseModel], before: str) -> Iterator[tuple[str, FieldInfo]]:
    for name, field in form.model_fields.items():
        inner = field.annotation
        if name != "car" and isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from _fields(inner, f"{before}{name}.")
        else:
            yield before + name, field


def car_identity(car: CarParameters) -> str:
    """Name and digest of all its values; those of :attr:`CarParameters.identity` are fewer."""
    return f"{car.name}-{digest([car.model_dump_json()])}"


class Files(dict[str, bytes]):
    """Content of the files that a plan names, by ``DIGEST/NAME``."""

    def add(self, path: Path, what: str) -> str:
        """Reads a file; its name here. InputError, which calls it ``what``, if it cannot."""
        data = read_whole(path, what, 1 << 28)
        name = f"{digest([data])}/{path.name}"
        self[name] = data
        return name


@dataclass(frozen=True)
class Case:
    """Settings and controllers; files by their names in :data:`Files`."""

    settings: RaceSettings
    controllers: tuple[Controller, ...] = PAPER
    weights: str = ""
    """Weights that are driven with in place of learned ones; empty without."""

    @property
    def key(self) -> str:
        """Changes with everything that shapes the result, but for the CPU that computes it."""
        settings = self.settings.model_dump_json(exclude={"threads"})
        return digest([settings, *self.controllers, "", self.weights, software_identity()])

    @property
    def columns(self) -> dict[str, Any]:
        """What all rows of the case share: its key, every factor, and the whole settings."""
        settings = self.settings
        values = {name: attrgetter(name)(settings) for name in factors()}
        return {
            "key": self.key,
            **values | {"car": settings.car.name, "kernels": "+".join(settings.kernels)},
            "car_identity": car_identity(settings.car),
            "settings": settings.model_dump_json(exclude=_LEFT_OUT),
        }

    def task(self) -> str:
        """The case as JSON, with the identity of the software that is to compute it."""
        settings = self.settings.model_dump(mode="json")
        return json.dumps(vars(self) | {"settings": settings, "software": software_identity()})

    @classmethod
    def of_task(cls, task: str, files: dict[str, bytes]) -> "Case":
        """The case, with its files written where this machine's cache is.

        Raises RuntimeError if it was made by another version of the software.
        """
        data = json.loads(task)
        if data["software"] != software_identity():
            raise RuntimeError("this worker runs another version of bayesrace or its libraries")
        placed = {name: _placed(data["settings"][name], files) for name in ("track", "train_track")}
        # Workers share the processors: each trains in one thread.
        settings = RaceSettings.model_validate(data["settings"] | placed | {"threads": 1})
        return cls(settings, tuple(data["controllers"]), _placed(data["weights"], files))


def _placed(name: str, files: dict[str, bytes]) -> str:
    """Where this machine has the file of that name; what names no file stays as it is."""
    if name not in files:
        return name
    path = cache_folder() / "campaign" / name
    if not path.exists() or read_whole(path, "a file of the campaign") != files[name]:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, files[name])
    return str(path)
