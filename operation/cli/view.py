"""``view``: a run in a browser."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.operation.cli import options

if TYPE_CHECKING:
    from bayesrace.transport import Endpoints

__all__ = ["view"]


def view(
    viewer: "Endpoints",
    run: Path | None = options.argument(
        "RUN", "Folder of a race, or a log.", None, "the newest in runs/"
    ),
    live: bool = options.flag(
        "--live", "What is driven now: a race in runs/, or else all cars in the network."
    ),
    name: str = options.value("With --live: only the car of this name.", "", shown="all"),
    car: str = options.value(
        "Car of a log or in the network, for the outline: built-in name or TOML file.",
        "",
        shown="the default car",
    ),
    track: str = options.value(
        "Track of a log or of the cars in the network.", "", shown="as the log or the car says"
    ),
    host: str = options.value("Address to serve the page on.", "127.0.0.1", metavar="ADDRESS"),
    port: int = options.value("Port to serve the page on; 0: any.", 8866, min=0, max=65535),
    foxglove: int | None = options.value(
        "With --live: also show it to Foxglove or Lichtblick, which connect to this port.",
        None,
        metavar="PORT",
        min=0,
        max=65535,
        shown="not",
    ),
    out: Path | None = options.new_file("Write the page with its data to this file instead."),
) -> None:
    """Show a run in the browser: live, or when it is over.

    Serves a page of its own on this machine until Ctrl-C. Beyond loopback (--host) the address has
    a token, which a page needs.
    """
    from bayesrace.operation.view import serving

    if live and (run or out):
        raise InputError(f"--live and {'--out' if out else run} contradict each other")
    if not live and (given := "--foxglove" if foxglove is not None else "--name" if name else ""):
        raise InputError(f"{given} is for --live: it names what is driven now")
    if live:
        watched = serving.Live(viewer, name, car or DEFAULT_CAR, track, typer.echo)
        serving.follow_live(watched, host, port, foxglove, typer.echo)
    elif out is not None:
        serving.write_page(run or serving.newest_run(), track, car, out)
    else:
        serving.serve_run(run or serving.newest_run(), track, car, host, port, typer.echo)
