"""What the tests of several processes drive on, and the programs as a person would start them."""

import functools
import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesrace.codegen.build import PROGRAM, build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.operation.host import HostProgram
from bayesrace.raceline.line import RaceLine, write_raceline
from bayesrace.tracks import Track, write_track
from bayesrace.vehicles import get_car
from tests.conftest import fit_weights, offset_line
from tests.programs import COMMAND, PATIENCE_S, ROOT, environment

__all__ = [
    "Bridged",
    "Course",
    "Program",
    "free_port",
    "gentle_course",
    "started_host",
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
    host: HostProgram | None = None
    """The controller without Python, in place of the one in Python."""

    def controller(self, output: Path, *options: str | Path) -> "Program":
        """Starts a controller; the options are those that 'controller' and 'bridge' share."""
        if self.host is not None:
            return Bridged(output, self.host, "--track", self.track_file, *options)
        return Program(output, "controller", *self.arguments, *options)

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
    language: str = "Python",
) -> Course:
    """A wide oval of 5.5 m at a speed at which the network, not the tyres, is what is tested.

    On a machine with other work a car may be without an input for half a second: hence the width.
    ``language``: that of the controller; "C" is the one without Python, behind its bridge.
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
    artefact, host = build(BuildSettings())[0], None
    if language == "C":
        drives_by = get_car("orca"), track, line, _weights(), MpcSettings()
        (folder / "host").mkdir()  # its weights.bin is of another kind
        host = HostProgram.made(folder / "host", artefact, *drives_by)
    return Course(track, line, *files, artefact, host)


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


class Bridged(Program):
    """A running controller without Python, and the bridge that joins the network for it."""

    def __init__(self, output: Path, host: HostProgram, *options: str | Path) -> None:
        """The options are those of ``bayesrace bridge``, whose process is :attr:`process`."""
        self._drives_by = host, f"udp:127.0.0.1:{free_port()}"
        self._running = ExitStack()
        self.host = self._running.enter_context(started_host(*self._drives_by))
        super().__init__(output, "bridge", self._drives_by[1], *options)

    def restart(self) -> None:
        """Kills the program alone, and starts another one in its place."""
        self._running.close()
        self.host = self._running.enter_context(started_host(*self._drives_by))

    def kill(self) -> None:
        """Both, as a machine that is switched off."""
        self._running.close()
        super().kill()

    def end(self) -> None:
        """The bridge first: it would say that the program is gone. Which states were stale the
        program alone knows."""
        super().end()
        self.host.terminate()
        _, said = self.host.communicate(timeout=PATIENCE_S)
        assert (self.host.returncode, "stale 0," in said) == (0, True), said


@contextmanager
def started_host(host: HostProgram, link: str, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """The program, ready; killed at the end if it runs then."""
    line = [str(host.folder / PROGRAM), str(host.folder), link, "--telemetry", *options]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            said = process.stderr.readline()
            assert "ready" in said, said
            yield process
        finally:
            process.kill()


def free_port() -> int:
    """Of UDP, on loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


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
    return course.controller(folder / f"{name}-controller.txt", *where, *_parent(), *options)


def start_router(folder: Path, listen: str) -> Program:
    """A router; it does not outlive this process."""
    return Program(folder / "router.txt", "router", "--listen", listen, *_parent())


def _each(option: str, values: Sequence[str]) -> list[str]:
    return [word for value in values for word in (option, value)]
