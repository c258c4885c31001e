"""What the tests of several processes drive on, and the programs as a person would start them."""

import functools
import os
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.raceline.line import RaceLine, write_raceline
from bayesrace.tracks import Track, write_track
from bayesrace.vehicles import get_car
from tests.conftest import fit_weights, offset_line
from tests.programs import COMMAND, PATIENCE_S, ROOT, environment

__all__ = [
    "Course",
    "Program",
    "gentle_course",
    "start_controller",
    "start_plant",
]


@dataclass(frozen=True, eq=False)
class Course:
    """A track with a line, as objects and as files, and a controller built for it."""

    track: Track
    line: RaceLine
    track_file: Path
    line_file: Path
    weights_file: Path
    artefact: Path

    @property
    def arguments(self) -> tuple[str | Path, ...]:
        """What a controller is to drive."""
        return (
            "--artefact", self.artefact, "--track", self.track_file, "--raceline", self.line_file,
            "--weights", self.weights_file,
        )  # fmt: skip


def gentle_course(
    folder: Path,
    speed_mps: float = 0.65,
    centre_m: tuple[float, float] = (0.0, 0.0),
    scale: float = 1.0,
) -> Course:
    """A wide oval of 5.5 m at a speed at which the network, not the tyres, is what is tested.

    On a machine with other work a car may be without an input for half a second: hence the width.
    """
    half_width_m = 0.5 * scale
    angle = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    oval = scale * np.column_stack([np.cos(angle), 0.75 * np.sin(angle)])
    track = Track.from_points("oval", oval + np.array(centre_m), half_width_m, half_width_m)
    line = offset_line(track, offset_m=0.02, lateral_mps2=3.0, v_max=speed_mps)
    files = folder / "track.csv", folder / "line.csv", folder / "weights.bin"
    write_track(files[0], track)
    write_raceline(files[1], line)
    write_weights(files[2], _weights())
    return Course(track, line, *files, build(BuildSettings())[0])


@functools.cache
def _weights() -> Weights:
    """Without, the car would snake from 1.4 m/s on."""
    return fit_weights(get_car("orca"), ("rbf", "matern25", "matern15"))


class Program:
    """A running ``bayesrace`` subcommand."""

    def __init__(self, output: Path, *arguments: str | Path, prefix: Sequence[str] = ()) -> None:
        """``prefix``: a command that runs it, such as ``unshare``."""
        self._output = output
        with output.open("ab") as file:
            self.process = subprocess.Popen(
                [*prefix, *COMMAND, *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
                env=environment(),
            )

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: Any) -> None:
        self.kill()

    def said(self) -> str:
        """Output so far."""
        return self._output.read_text(errors="replace")

    def kill(self) -> None:
        """SIGKILL, as kill -9 does it."""
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        """SIGTERM, upon which it ends in order and without a complaint."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(PATIENCE_S) == 0, self.said()
        assert "Traceback" not in self.said()


def _parent() -> tuple[str, ...]:
    return "--parent-pid", str(os.getpid())


def start_plant(
    folder: Path,
    listen: str,
    *options: str,
    connect: Sequence[str] = (),
    name: str = "orca",
) -> Program:
    """A plant that listens there; it does not outlive this process."""
    where = ("--name", name, "--endpoint", listen, *_each("--connect", connect))
    return Program(folder / f"{name}-plant.txt", "plant", *where, *_parent(), *options)


def start_controller(
    folder: Path,
    course: Course,
    connect: str,
    listen: str,
    *options: str,
    name: str = "orca",
) -> Program:
    """A controller that connects to its plant, or a router, there; it does not outlive this
    process."""
    where = ("--name", name, "--endpoint", connect, "--listen", listen)
    output = folder / f"{name}-controller.txt"
    arguments = ("controller", *course.arguments, *where, *_parent(), *options)
    return Program(output, *arguments)


def start_router(folder: Path, listen: str) -> Program:
    """A router; it does not outlive this process."""
    return Program(folder / "router.txt", "router", "--listen", listen, *_parent())


def _each(option: str, values: Sequence[str]) -> list[str]:
    return [word for value in values for word in (option, value)]
