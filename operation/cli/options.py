"""Options that are no fields of settings: how they are declared, and those that several commands
have. :func:`operation.cli.declaration.configured` adds metavars by type where there are none."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole

if TYPE_CHECKING:
    from pydantic import BaseModel

    from operation.terminal.progress import Stages

__all__ = [
    "AllSamples", "Artefact", "Car", "CarName", "Course", "Endpoint", "GivenLine", "LowLatency",
    "MpcFile", "OutFile", "ParentPid", "RaceLineFile", "TrackName", "Tyres", "Weights", "argument",
    "flag", "new_file", "out_folder", "run_folder", "stages_shown", "value", "writable",
    "write_json",
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


def out_folder(text: str, shown: str = "") -> Any:
    """A folder to write into."""
    return value(text, None, "--out", "-o", metavar="DIR", shown=shown)


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
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal

    with stages_on(Terminal()) as stages:
        yield stages


Car = Annotated[str, typer.Option(help="Car: built-in name or TOML file.")]
CarName = Annotated[
    str, typer.Option(show_default="the car's own", help="Name of the car in the network.")
]
Tyres = Annotated[
    Literal["pacejka", "linear"] | None,
    typer.Option(
        metavar="TYRES",
        show_default="the car's",
        help="pacejka: of the same stiffness as the car's linear tyres, saturating.",
    ),
]
TrackName = Annotated[
    str,
    typer.Option(
        show_default="the car's", help="Built-in name, random:SEED, random10:SEED or CSV file."
    ),
]
Course = Annotated[
    str,
    typer.Argument(metavar="TRACK", help="Built-in name, random:SEED, random10:SEED or CSV file."),
]
RaceLineFile = Annotated[Path, typer.Option(help="Racing line, as 'bayesrace raceline' writes it.")]
GivenLine = Annotated[
    Path | None,
    typer.Option(
        show_default="computed", help="Racing line to drive, as 'bayesrace raceline' writes it."
    ),
]
Weights = Annotated[
    Path | None, typer.Option(help="GP weights; without them, the uncorrected model.")
]
Artefact = Annotated[
    Path | None,
    typer.Option(metavar="DIR", show_default="built", help="Folder of 'bayesrace build'."),
]
MpcFile = Annotated[
    Path | None, typer.Option("--settings", help="OCP settings (JSON): controller/settings.py.")
]
AllSamples = Annotated[
    bool,
    typer.Option(
        "--all-samples",
        help="Keep samples beyond the car's limits, as the paper's published drives have them.",
    ),
]
Endpoint = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        show_default="as configured; tcp/127.0.0.1:7447 and :7448",
        help="Zenoh endpoint of a plant, a controller or a router; repeatable.",
    ),
]
OutFile = Annotated[Path, typer.Option("--out", "-o", callback=writable, help="File to write.")]
LowLatency = Annotated[
    bool,
    typer.Option(
        "--low-latency",
        help="Send in the calling thread: in lockstep only, on both plant and controller.",
    ),
]
ParentPid = Annotated[int | None, typer.Option(hidden=True, help="End when this parent ends.")]
