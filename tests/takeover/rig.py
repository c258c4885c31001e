"""A plant and a controller that takes weights, as processes; and their director and recorder."""

import hashlib
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.gp.weights import Weights, encode_weights, write_weights
from bayesrace.log import LogReader
from bayesrace.messages import EVENT, STATE, TELEMETRY, Event, Reply, State, car_key, decode
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.raceline.line import write_raceline
from bayesrace.recorder import Recorder
from bayesrace.tracks import Track, write_track
from bayesrace.transport import (
    Director,
    Endpoints,
    RefusedError,
    free_endpoint,
    open_session,
)
from bayesrace.vehicles import get_car
from tests.conftest import fit_weights, offset_line
from tests.network.cars import Course, Program, start_controller, start_plant

__all__ = ["DRIVEN_S", "Rig", "digest", "judges", "make_course", "rigged"]

KINDS = ("rbf", "matern25", "matern15")
_LATE = 5
"""Periods without an answer that the car does not mind."""
DRIVEN_S = 4.0
"""Of plant time: more than a lap of the circuit."""


def make_course(folder: Path) -> Course:
    """Bends to both sides, and 15 cm to the edges."""
    angle = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    radius = 0.8 + 0.32 * np.cos(2 * angle)
    points = np.column_stack([1.15 * radius * np.cos(angle), radius * np.sin(angle)])
    track = Track.from_points("peanut", points, 0.2, 0.2)
    line = offset_line(track, offset_m=0.05, lateral_mps2=4.5, v_max=2.2)
    files = folder / "track.csv", folder / "line.csv", folder / "weights.bin"
    write_track(files[0], track)
    write_raceline(files[1], line)
    write_weights(files[2], fit_weights(get_car("orca"), KINDS, count=300))
    return Course(track, line, *files, build(BuildSettings())[0])


@dataclass
class Rig:
    """Both processes, their director and their recorder."""

    session: Any
    director: Director
    controller: Program
    plant: Program
    track: Track
    log: Path
    recorder: Recorder
    newest: Callable[[], State | None]

    def start(self, run: int, lockstep: bool = True, seconds: float = DRIVEN_S) -> None:
        self.director.wait_for(("plant", "controller"), 20.0)
        plan = RunPlan(run, "test", 1, seconds, lockstep)
        self.director.start(replace(run_request(self.track, plan), laps=0, max_time_s=seconds))

    def drive(self, run: int, seconds: float = DRIVEN_S) -> Event:
        """In lockstep, to the end."""
        self.start(run, seconds=seconds)
        return self.director.wait_for_end(run, 60.0)

    def answer(self, data: bytes, again: int = 2) -> Reply:
        """To weights, sent again, as asked, where a busy machine could not check them in time."""
        try:
            reply = self.director.send_weights(data)
        except RefusedError as refused:
            reply = refused.reply
        late = "did not end in time" in reply.text
        return self.answer(data, again - 1) if late and again else reply

    def send(self, weights: Weights) -> dict[str, Any]:
        """Data of the answer."""
        reply = self.answer(encode_weights(weights))
        assert reply.accepted, reply.text
        return dict(reply.data)

    def drive_and_send(self, run: int, weights: Weights, seconds: float) -> list[int]:
        """In lockstep, sending weights twice; the cycles that the answers name."""
        self.start(run, seconds=seconds)
        cycles = [self.send(weights)["cycle"] for _ in range(2)]
        self.director.wait_for_end(run, 60.0)
        return cycles

    def refusal(self, data: bytes) -> str:
        """Why they are not taken over."""
        reply = self.answer(data)
        assert not reply.accepted
        return reply.text

    def status(self) -> Any:
        return self.director.status("controller")

    def counters(self) -> dict[str, Any]:
        return dict(self.status().counters)

    def reader(self) -> LogReader:
        self.recorder.drain()
        return LogReader(self.log)

    def states(self, run: int) -> list[State]:
        return [one for one in self.reader().select(STATE) if one.run == run]

    def ticks(self, run: int) -> list[int]:
        """Numbers of its cycles."""
        return [one.tick for one in self.reader().select(TELEMETRY) if one.run == run]

    def events(self, kind: str) -> list[Event]:
        found = [one for one in self.reader().select(EVENT) if one.source == "controller"]
        return [one for one in found if one.kind == kind]

    def held_up(self, end: Event) -> bool:
        """Whether the machine stalled in a run in real time, the first: the stall may have
        taken the car off the track."""
        periods = self.counters()["skipped"] + int(end.data["overruns"])
        return periods > 0 or int(end.data["late"]) > _LATE

    def off_track_m(self, run: int) -> float:
        xy = np.array([one.x[:2] for one in self.states(run)])
        return float(self.track.project_path(xy).off_track_m.max())


@contextmanager
def rigged(folder: Path, course: Course, *options: str) -> Iterator[Rig]:
    at_plant, at_controller = free_endpoint(), free_endpoint()
    log = folder / f"{time.monotonic_ns()}.mcap"
    with ExitStack() as stack:
        plant = stack.enter_context(start_plant(folder, at_plant))
        controller = stack.enter_context(
            start_controller(folder, course, at_plant, at_controller, *options)
        )
        session = stack.enter_context(open_session(Endpoints(connect=(at_plant, at_controller))))
        recorder = stack.enter_context(Recorder(session, "orca", log))
        heard = [b""]
        subscriber = session.declare_subscriber(
            car_key(STATE.key, "orca"), lambda sample: heard.append(sample.payload.to_bytes())
        )
        director = Director(session, "orca")
        director.wait_for(("plant", "controller"), 20.0)
        yield Rig(
            session, director, controller, plant, course.track, log, recorder,
            lambda: decode(State, heard[-1]) if heard[-1] else None,
        )  # fmt: skip
        subscriber.undeclare()
        controller.end()
        plant.end()


def digest(states: list[State]) -> str:
    rows = b"".join(struct.pack("<10d", one.time_s, *one.x, *one.u_applied) for one in states)
    return hashlib.sha256(rows).hexdigest()


def judges(of: int) -> list[int]:
    """Process numbers of a controller's children that judge weights."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, ValueError, IndexError):
            continue
        if b"bayesrace.controller.weights.checks" in words and parent == of:
            found.append(int(entry.name))
    return found
