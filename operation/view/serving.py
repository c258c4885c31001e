"""``bayesrace view``: what is shown, and for how long."""

import os
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.operation.view.network import AbsentError, network_source
from bayesrace.operation.view.page import whole_page
from bayesrace.operation.view.server import Viewer, in_url
from bayesrace.operation.view.sources import Source, all_updates, driven_race, race_logs, run_source
from bayesrace.tracks import load_track
from bayesrace.transport import Endpoints
from bayesrace.vehicles import get_car

__all__ = ["Live", "follow_live", "newest_run", "serve_run", "write_page"]

_RUNS: Final = Path("runs")
_READ_S: Final = 0.1
_NETWORK_S: Final = 1.0
_LOOK_S: Final = 1.0
_NICE: Final = 15
"""On a machine with few processors, who looks on gives way to plant and controller."""
Say = Callable[[str], object]


def newest_run() -> Path:
    """The newest run in the folder of runs; InputError if there is none."""
    if not (logs := race_logs(_RUNS)):
        raise InputError(
            f"no run in {_RUNS.absolute()}: name one, or drive one by 'bayesrace race'"
        )
    return logs[-1].parent


def write_page(run: Path, track: str, car: str, out: Path) -> None:
    """A run as one page that needs nothing else."""
    source = run_source(run, track, car)
    source.read_all()
    write_whole(out, whole_page(all_updates(source)))


def serve_run(run: Path, track: str, car: str, host: str, port: int, say: Say) -> None:
    """A run, and what is added to its log, or takes its place, until Ctrl-C."""
    with Viewer(host, port) as viewer:
        source = run_source(run, track, car)
        source.read_all()
        viewer.show(source)
        say(f"{viewer.address} shows {run}; Ctrl-C ends it")
        while True:
            time.sleep(_READ_S)
            viewer.read()
            if source.replaced:
                with suppress(InputError):  # not all of it is there yet
                    source = run_source(run, track, car)
                    viewer.show(source)


class Live:
    """What is driven now: a race in the folder of runs, then the next one; or else the cars in the
    network."""

    def __init__(self, endpoints: Endpoints, name: str, car: str, track: str, say: Say) -> None:
        """InputError for a car or track that is not known."""
        self._endpoints, self._name, self._say = endpoints, name, say
        self._car, self._track = get_car(car), load_track(track) if track else None
        self._shown: Source | None = None
        self._joined = ExitStack()
        """The link to the network, while its cars are shown."""
        self._said = ""

    def another(self) -> Source | None:
        """A source that is to be shown from now on, if there is one."""
        source = driven_race(_RUNS, self._shown)
        if source is not None:
            self._joined.close()
        elif self._shown is None or self._shown.replaced or not self._shown.written:
            source = self._of_network()
        if source is not None:
            self._shown = source
            self._say(f"{source.title} is shown")
        return source

    def _of_network(self) -> Source | None:
        """Cars that are there, in place of those that are there no more."""
        with ExitStack() as joined:
            try:
                source = joined.enter_context(
                    network_source(
                        self._endpoints, self._name, self._track, self._car, timeout_s=_NETWORK_S
                    )
                )
            except AbsentError as error:
                if not self._said:
                    self._said = str(error)
                    self._say(f"waiting for a race in {_RUNS}/, or a car: {self._said}")
                return None
            self._joined.close()
            self._joined = joined.pop_all()
            return source

    def close(self) -> None:
        """Leaves the network."""
        self._joined.close()


def follow_live(live: Live, host: str, port: int, foxglove_port: int | None, say: Say) -> None:
    """Serves what is driven until Ctrl-C.

    ``foxglove_port``: viewers of Foxglove's protocol connect there; None: they do not.
    """
    os.nice(_NICE)
    with Viewer(host, port) as viewer, ExitStack() as stack:
        stack.callback(live.close)
        foxglove = None
        if foxglove_port is not None:
            from bayesrace.operation.view.foxglove import serve  # of an extra

            foxglove = stack.enter_context(serve(host, foxglove_port))
            say(f"Foxglove and Lichtblick connect to ws://{in_url(host)}:{foxglove.port}")
        say(f"{viewer.address} shows what is driven; Ctrl-C ends it")
        looked_s = 0.0
        while True:
            if (now_s := time.monotonic()) - looked_s >= _LOOK_S:
                looked_s = now_s
                if (source := live.another()) is not None:
                    viewer.show(source)
                    if foxglove is not None:
                        foxglove.show(source.scene())
            entries = viewer.read()
            if foxglove is not None:
                foxglove.take(entries)
            time.sleep(_READ_S)
