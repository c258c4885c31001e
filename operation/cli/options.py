"""Options that are no fields of settings: how they are declared, and those that several commands
have. :func:`bayesrace.operation.cli.declaration.configured` adds metavars by type where there are
none."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.files import write_whole

if TYPE_CHECKING:
    from pydantic import BaseModel

    from bayesrace.operation.terminal.terminal import Stages

__all__ = [
    "ALL_SAMPLES", "ARTEFACT", "CAR", "CAR_NAME", "COURSE", "ENDPOINT", "GIVEN_LINE", "LOW_LATENCY",
    "MPC", "PARENT_PID", "RACELINE", "TRACK", "TRACK_GIVEN", "TYRES", "WEIGHTS", "Tyres",
    "argument", "flag", "new_file", "out_file", "out_folder", "run_folder", "stages_shown", "value",
    "writable", "write_json",
]  # fmt: skip


def value(text: str, default: Any = None, *names: str, shown: str = "", **more: Any) -> Any:
    """An option with a value; ``shown``: its default in words."""
    return typer.Option(default, *names, help=text, show_default=shown or True, **more)


def argument(metavar: str, text: str, default: Any = ..., shown: str = "") -> Any:
    """A word of the command that is no option."""
    return typer.Argument(default, metavar=metavar, help=text, show_default=shown or True)


def flag(name: str, text: str) -> Any:
    """An option without a value."""
    return typer.Option(False, name, help=text)


def new_file(text: str, *names: str, default: Path | None = None) -> Any:
    """A file to write, refused before the work if it cannot be."""
    return value(text, default, *names, metavar="FILE", callback=writable)


def out_file(default: Any) -> Any:
    """The file that the command is for."""
    return value("File to write.", default, "--out", "-o", metavar="FILE", callback=writable)


def out_folder(text: str, shown: str = "", default: Path | None = None) -> Any:
    """A folder to write into."""
    return value(text, default, "--out", "-o", metavar="DIR", shown=shown)


def writable(path: Path | None) -> Path | None:
    """Callback of options that name a file to write: InputError before the work, not after it."""
    if path is not None and not path.parent.is_dir():
        raise InputError(f"cannot write {path}: no folder {path.parent}; make it first")
    if path is not None and path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder; name a file in it")
    return path


def write_json(path: Path | None, result: "BaseModel") -> None:
    """Writes a result to the file, if one is given."""
    if path is not None:
        write_whole(path, result.model_dump_json(indent=1) + "\n")


def run_folder(given: Path | None, prefix: str = "") -> Path:
    """The folder given, or one named after the time."""
    stamp = datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    return given or Path("runs") / f"{prefix}{stamp}"


@contextmanager
def stages_shown() -> Iterator["Stages"]:
    """The stages of the work, shown on the terminal."""
    from bayesrace.operation.terminal.terminal import Terminal, stages_on

    with stages_on(Terminal()) as stages:
        yield stages


_RACELINE = "as 'bayesrace raceline' writes it."
_TRACKS = "Built-in name, random:SEED, random10:SEED or CSV file."

Tyres = Literal["pacejka", "linear"] | None

ALL_SAMPLES: Final = flag(
    "--all-samples",
    "Keep samples beyond the car's limits, as the paper's published drives have them.",
)
ARTEFACT: Final = value("Folder of 'bayesrace build'.", metavar="DIR", shown="built")
CAR: Final = value("Car: built-in name or TOML file.", DEFAULT_CAR)
CAR_NAME: Final = value("Name of the car in the network.", "", shown="the car's own")
COURSE: Final = argument("TRACK", _TRACKS)
ENDPOINT: Final = value(
    "Zenoh endpoint of a plant, a controller or a router; repeatable.",
    (),
    metavar="ENDPOINT",
    shown="as configured; tcp/127.0.0.1:7447 and :7448",
)
GIVEN_LINE: Final = value(f"Racing line to drive, {_RACELINE}", shown="computed")
LOW_LATENCY: Final = flag(
    "--low-latency", "Send in the calling thread: in lockstep only, on both plant and controller."
)
MPC: Final = value("OCP settings (JSON): controller/settings.py.", None, "--settings")
PARENT_PID: Final = value("End when this parent ends.", hidden=True)
RACELINE: Final = value(f"Racing line, {_RACELINE}", ...)
TRACK: Final = value(_TRACKS, "", shown="the car's")
TRACK_GIVEN: Final = value(_TRACKS, ...)
TYRES: Final = value(
    "pacejka: of the same stiffness as the car's linear tyres, saturating.", shown="the car's"
)
WEIGHTS: Final = value("GP weights; without them, the uncorrected model.")
