"""Options that several subcommands share."""

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["Car", "LowLatency", "OutFile", "ParentPid", "RaceLineFile", "TrackName"]

Car = Annotated[str, typer.Option(help="Built-in car.")]
TrackName = Annotated[str, typer.Option(help="Track: built-in name, random:SEED or CSV file.")]
RaceLineFile = Annotated[
    Path, typer.Option("--raceline", help="Racing line file, as 'bayesrace raceline' writes it.")
]
OutFile = Annotated[Path, typer.Option("--out", "-o", help="File to write.")]
LowLatency = Annotated[
    bool,
    typer.Option(
        help="Send in the calling thread. For lockstep, on plant and controller alike.",
    ),
]
ParentPid = Annotated[int | None, typer.Option(hidden=True, help="End when this parent ends.")]
