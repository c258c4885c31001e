"""A plant and a controller of real processes over secured links, directed and recorded."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from bayesrace.configuration import read_configuration
from bayesrace.messages import Event
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.recorder import Recorder
from bayesrace.transport import Director, free_endpoint, open_session
from tests.network.cars import Course, Program, gentle_course
from tests.network.observer import Journey
from tests.programs import PATIENCE_S, ROOT
from tests.security.authority import CAR, Bundles, written

__all__ = ["BOTH", "Rig", "attacking", "course", "secured"]


BOTH: Final = pytest.mark.parametrize(
    "course", ["Python", pytest.param("C", marks=pytest.mark.check)], indirect=True
)
"""By the controller in Python, and by that without and its bridge."""


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Course:
    """For the controller in Python, or by parameter for that without."""
    language = getattr(request, "param", "Python")
    return gentle_course(tmp_path_factory.mktemp("course"), language=language)


@dataclass
class Rig:
    """A secured plant and controller, and their director."""

    config: Path
    bundles: Bundles
    plant_at: str
    director: Director
    course: Course
    log: Path
    closing: ExitStack
    plant: Program
    controller: Program
    router: Program | None = None

    def drive(self, number: int, *, lockstep: bool, laps: int = 1) -> None:
        """Starts a run."""
        plan = RunPlan(number, "test", laps, 600.0, lockstep)
        self.director.start(run_request(self.course.track, plan))

    def end(self, number: int) -> Event:
        """How it ended."""
        return self.director.wait_for_end(number, PATIENCE_S)

    def count(self, source: str, *names: str) -> dict[str, object]:
        """Counters of a process."""
        counters = self.director.status(source).counters
        return {name: counters[name] for name in names}

    def phase(self) -> str:
        """Of the controller."""
        return self.director.status("controller").phase

    def journey(self) -> Journey:
        """What was recorded; ends the recording."""
        self.closing.close()
        return Journey(self.log, self.course.track)


@contextmanager
def secured(
    folder: Path, course: Course, bundles: Bundles, *, router: bool = False
) -> Iterator[Rig]:
    """Plant and controller as processes, and their director here; with a router between them."""
    plant_at, controller_at, router_at = (free_endpoint("tls") for _ in range(3))
    config = written(folder, bundles, plant_at, controller_at)
    if router:
        text = config.read_text().replace("[network]", f'[network]\nrouter = ["{router_at}"]')
        config.write_text(text)
    options = ("--config", config)
    with ExitStack() as stack:
        between: Program | None = None
        if router:
            between = stack.enter_context(Program(folder / "router.txt", "router", *options))
        plant = stack.enter_context(Program(folder / "plant.txt", "plant", *options))
        controller = stack.enter_context(course.controller(folder / "controller.txt", *options))
        endpoints = read_configuration(config).endpoints("director")
        closing = stack.enter_context(ExitStack())
        session = closing.enter_context(open_session(endpoints, "director"))
        director = Director(session, CAR)
        director.wait_for(("plant", "controller"), PATIENCE_S)
        log = folder / "run.mcap"
        closing.enter_context(Recorder(session, CAR, log))
        yield Rig(
            config, bundles, router_at if router else plant_at, director, course, log, closing,
            plant, controller, between,
        )  # fmt: skip


@contextmanager
def attacking(
    module: str, begins: str, *words: str | Path | int, prefix: Sequence[str] = ()
) -> Iterator[list[str]]:
    """For the block, that program runs; it prints ``begins``, and at its end what is then given.

    ``prefix``: a command that runs it, such as ``ip netns exec``.
    """
    attacker = subprocess.Popen(
        [*prefix, sys.executable, "-m", f"tests.security.{module}", *map(str, words)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert attacker.stdout is not None
    assert attacker.stdout.readline() == f"{begins}\n"
    said: list[str] = []
    try:
        yield said
    finally:
        said += attacker.communicate("", timeout=PATIENCE_S)[0].split()
