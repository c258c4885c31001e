"""A plant and a controller that needs no solver, as processes, their director, their observer."""

import contextlib
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.messages import STATE, Event, RunRequest, State, car_key, decode
from bayesrace.recorder import Recorder
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session
from tests.programs import ROOT, until

__all__ = [
    "CONTROLLER",
    "PATIENCE_S",
    "PLANT",
    "Rig",
    "Spectator",
    "request",
    "running_rig",
    "start",
]

PATIENCE_S = 60.0
"""For what takes a second at most on an idle machine."""

PLANT = """
import json, sys
from bayesrace.plant.process import main
from bayesrace.plant.process_settings import PlantSettings
sys.exit(main(PlantSettings.model_validate_json(sys.argv[1])))
"""

CONTROLLER = """
import sys
from pathlib import Path
import numpy as np
from bayesrace.vehicles import get_car
from bayesrace.controller.process import ControllerSettings, main
from bayesrace.controller.pure_pursuit import PurePursuit, PurePursuitSettings
from bayesrace.controller.python_controller import PythonController
assert not {"casadi", "sklearn", "matplotlib", "scipy"} & set(sys.modules), "slow imports"
s = np.linspace(0, 2 * np.pi, 200, endpoint=False)
law = PurePursuit(get_car("orca"), 2 * np.cos(s), np.sin(s), np.full(200, 1.5),
                  PurePursuitSettings(seed=int(sys.argv[2])))
controller = PythonController(Path(sys.argv[3]), law)
sys.exit(main(ControllerSettings.model_validate_json(sys.argv[1]), controller))
"""


def start(code: str, *arguments: str) -> subprocess.Popen[str]:
    """Runs Python code as a process; its outputs are one text."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def request(run: int, **changes: Any) -> RunRequest:
    """A run on the oval (2 m by 1 m) from the start line at its rightmost point."""
    x0 = (2.0, 0.0, math.pi / 2, 0.1, 0.0, 0.0, 0.0)
    values: dict[str, Any] = {
        "lockstep": True, "x0": x0, "line_x_m": 2.0, "line_y_m": 0.0,
        "line_heading_rad": math.pi / 2, "line_left_m": 0.3, "line_right_m": 0.3, "laps": 1,
        "max_time_s": 60.0, "actuation_timeout_s": 5.0, "held": False, "exact": False,
        "pause_s": 0.0,
    }  # fmt: skip
    return RunRequest(seq=0, source_time_ns=time.monotonic_ns(), run=run, **(values | changes))


class Spectator:
    """Sees the states that a plant publishes from now on."""

    def __init__(self, session: Any) -> None:
        self._newest = b""
        self._subscriber = session.declare_subscriber(car_key(STATE.key, "orca"), self._see)

    def _see(self, sample: Any) -> None:
        self._newest = sample.payload.to_bytes()

    def wait_for(self, run: int, true: Callable[[State], bool], what: str) -> State:
        """The first state seen of the run of which this holds."""
        seen: list[State] = []

        def holds() -> bool:
            state = decode(State, self._newest) if self._newest else None
            if state is not None and state.run == run and true(state):
                seen.append(state)
            return bool(seen)

        until(holds, what, PATIENCE_S)
        return seen[0]


@dataclass
class Rig:
    """Both processes, and a session that is connected to both; each run has its own number."""

    plant: subprocess.Popen[str]
    at_plant: str
    """Its endpoint."""
    controller: subprocess.Popen[str]
    session: Any
    director: Director
    spectator: Spectator
    runs: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def start(self, **changes: Any) -> int:
        """Starts a run, which is :func:`request` but for the changes; its number."""
        run = next(self.runs)
        self.director.start(request(run, **changes))
        return run

    def drive(self, log: Path, **changes: Any) -> Event:
        """A run to its end, recorded without a gap; how it ended."""
        with Recorder(self.session, "orca", log) as recorder:
            self.director.wait_for(("plant", "controller"), PATIENCE_S)
            end = self.director.wait_for_end(self.start(**changes), 60.0)
        assert recorder.counters.missing == 0, recorder.gaps
        assert recorder.counters.unnumbered == 0
        return end

    def wait_until_driving(self, run: int) -> None:
        """Until the car has got faster than it started."""
        self.spectator.wait_for(run, lambda state: state.x[3] > 0.5, f"run {run} drives")

    def wait_for_phase(self, source: str, phase: str) -> None:
        """Until a process says that it is in this phase."""
        until(lambda: self.director.status(source).phase == phase, phase, PATIENCE_S)


@contextlib.contextmanager
def running_rig(
    plant_settings: Mapping[str, Any] | None = None,
    *,
    seed: int = 1,
    low_latency: bool = True,
    controller_code: str = CONTROLLER,
) -> Iterator[Rig]:
    """Both processes, ready; ended in order, whatever became of them meanwhile."""
    at_plant, at_controller = free_endpoint(), free_endpoint()

    def settings(listen: str, *connect: str, **more: Any) -> str:
        ends = {"listen": [listen], "connect": list(connect), "low_latency": low_latency}
        return json.dumps({"endpoints": ends, "parent_pid": os.getpid(), **more})

    plant = start(PLANT, settings(at_plant, **(plant_settings or {})))
    artefact, _ = build(BuildSettings())
    at = settings(at_controller, at_plant)
    controller = start(controller_code, at, str(seed), str(artefact))
    try:
        with open_session(Endpoints(connect=(at_plant, at_controller))) as session:
            director = Director(session, "orca")
            director.wait_for(("plant", "controller"), PATIENCE_S)
            yield Rig(plant, at_plant, controller, session, director, Spectator(session))
    finally:
        for process in (controller, plant):
            process.send_signal(signal.SIGTERM)
        for process in (controller, plant):
            output, _ = process.communicate(timeout=PATIENCE_S)
            assert "Traceback" not in output, output
