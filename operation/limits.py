"""The limits of a race's car and track, which its laps are compared with.

Each is computed by ``bayesrace limit`` in a process of its own, at the lowest priority, while the
race prepares, and is in its run directory before the first drive begins: no control step is
measured beside it. The cache keeps it for the next race of the car on the track.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from bayesrace.cache import note_use
from bayesrace.errors import InputError
from bayesrace.limit import LimitSettings, known_limit, read_limit, write_limit
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.system import Child, child
from bayesrace.tracks import load_track

__all__ = ["limits_beside", "limits_in"]

_FILES: Final = {"standing": "limit-standing.csv", "flying": "limit-flying.csv"}
"""Names in a run directory."""

_PATIENCE_S: Final = 60.0
_LOWEST: Final = 19


@contextmanager
def limits_beside(settings: RaceSettings, car_file: str, out: Path) -> Iterator[Callable[[], None]]:
    """Computes the limits of a race beside the block, into its run directory ``out``.

    Yields what waits for them, at most a minute. A limit that is not found is left out; the
    reason is in a log named after it. ``car_file``: the race's car.
    """
    track = load_track(settings.track, settings.driven_car.width_m)
    with ExitStack() as stack:
        children: list[Child] = []
        for kind, name in _FILES.items():
            options = LimitSettings()
            if kind == "standing":
                options = LimitSettings(standing=True, start_speed_mps=settings.start_speed_mps)
            known = known_limit(track, settings.driven_car, options)
            if known is not None:
                write_limit(out / name, known)
                continue
            arguments = [
                "limit", settings.track, "--car", car_file, "--out", str(out / name),
                "--parent-pid", str(os.getpid()),
            ]  # fmt: skip
            if options.standing:
                arguments += ["--standing", "--start-speed", repr(options.start_speed_mps)]
            children.append(stack.enter_context(child(arguments, (out / name).with_suffix(".log"))))
            with suppress(OSError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, children[-1].pid, _LOWEST)

        def wait() -> None:
            deadline = time.monotonic() + _PATIENCE_S
            for one in children:
                one.wait(max(deadline - time.monotonic(), 0.0))
            note_use(made=bool(children))

        yield wait


def limits_in(out: Path) -> dict[str, float]:
    """Limits [s] in a run directory, by kind of lap, standing or flying; without any not found."""
    found = {}
    for kind, name in _FILES.items():
        with suppress(InputError):
            found[kind] = read_limit(out / name).lap_s
    return found
