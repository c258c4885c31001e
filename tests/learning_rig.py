"""A plant and a controller that learning jobs and publishers find, and runs for them."""

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayesrace.messages import Event, Status
from bayesrace.operation.learn.records import LapRecord
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.driven import blank
from tests.network.cars import Course, Program, start_controller, start_plant
from tests.programs import PATIENCE_S

__all__ = ["Rig", "controller_status", "lap", "learn_arguments", "record", "rigged"]


@dataclass
class Rig:
    """Both processes, their endpoints, and a director that starts runs."""

    folder: Path
    course: Course
    plant_at: str
    controller_at: str
    stack: ExitStack
    plant: Program
    controller: Program
    director: Director

    @property
    def endpoints(self) -> tuple[str, ...]:
        """As options."""
        return "--endpoint", self.plant_at, "--endpoint", self.controller_at

    def kill_both(self) -> None:
        """Kills plant and controller, and waits until their tokens are gone."""
        self.controller.kill()
        self.plant.kill()
        for source in ("plant", "controller"):
            self.director.wait_until_gone(source, PATIENCE_S)

    def start_plant(self) -> None:
        """Another one, where the first one was."""
        self.plant = self.stack.enter_context(start_plant(self.folder, self.plant_at))

    def start_controller(self, *options: str) -> None:
        """Another one, where the first one was."""
        program = start_controller(
            self.folder, self.course, self.plant_at, self.controller_at, *options
        )
        self.controller = self.stack.enter_context(program)

    def wait(self) -> None:
        """Until both are there."""
        self.director.wait_for(("plant", "controller"), PATIENCE_S)

    def drive(self, laps: int, *, lockstep: bool = True) -> Event:
        """A run from rest to its end."""
        self.wait()
        number = self.director.status("plant").run + 1
        plan = RunPlan(number, "test", laps, 120.0, lockstep)
        self.director.start(run_request(self.course.track, plan))
        return self.director.wait_for_end(number, PATIENCE_S)

    def version(self) -> str:
        """Of the weights that the controller drives with."""
        return self.director.status("controller").weights_version


@contextmanager
def rigged(folder: Path, course: Course, *options: str) -> Iterator[Rig]:
    """Both run when the block begins; ``options``: of the controller."""
    plant_at, controller_at = free_endpoint(), free_endpoint()
    with ExitStack() as stack:
        plant = stack.enter_context(start_plant(folder, plant_at))
        controller = stack.enter_context(
            start_controller(folder, course, plant_at, controller_at, *options)
        )
        connect = Endpoints(connect=(plant_at, controller_at))
        session = stack.enter_context(open_session(connect))
        director = Director(session, "orca")
        rig = Rig(folder, course, plant_at, controller_at, stack, plant, controller, director)
        rig.wait()
        yield rig


def learn_arguments(rig: Rig, out: Path, *options: str | Path) -> Sequence[str | Path]:
    """Of ``bayesrace learn`` for this rig."""
    return (
        "learn", "--watch", "--out", out, "--track", rig.course.track_file, *rig.endpoints, *options
    )  # fmt: skip


def record(out: Path) -> dict[str, Any]:
    """``laps.json`` of a job; empty lists before there is one."""
    path = out / "laps.json"
    if not path.exists():
        return {"laps": [], "updates": []}
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def lap(number: int, time_s: float | None, *, flying: bool = True, off_m: float = 0) -> LapRecord:
    """A lap as it is noted."""
    return LapRecord(
        lap=number, run=1, time_s=time_s, flying=flying, versions=["a"], samples=100, left_out={},
        fallbacks=0, off_track_m=off_m,
    )  # fmt: skip


def controller_status(version: str) -> Status:
    """A heartbeat of a controller that drives with these weights."""
    named = {"source": "controller", "phase": "driving", "weights_version": version}
    return blank(Status, **named, rate_hz=50.0)
