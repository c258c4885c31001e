"""A scenario in real time: a plant and a controller process, with a relay between them where their
link is to fail; or processes that were started elsewhere."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from bayesrace.configuration import configured
from bayesrace.messages import EVENT, Event, Message, Service
from bayesrace.operation.drive import execute
from bayesrace.operation.driving_system import DrivingSystem, Part
from bayesrace.operation.race import plant_options
from bayesrace.operation.system import CONFIGURATION, child, private_network, started_system
from bayesrace.plant.faults import write_sensor_faults
from bayesrace.recorder import Recorder
from bayesrace.scene import Scene
from bayesrace.studies.evidence.scenario.events import LinkEvent, PartitionEvent, timeline
from bayesrace.studies.evidence.scenario.preparing import Ready
from bayesrace.studies.evidence.scenario.simulated import SETTLING_S
from bayesrace.transport import Director, Publisher, ask, free_endpoint, open_session
from bayesrace.transport.relay import Link, Relay
from bayesrace.vehicles import car_text, write_car

__all__ = ["drive_real"]

A = TypeVar("A", bound=Message)

_LOOK_S: Final = 0.005
_WAYS: Final = {"controller": "forth", "plant": "back"}
"""Of the relay, whose target is the plant, by who receives."""


class _Processes(DrivingSystem):
    """Processes in real time, over a session of the time line's own."""

    def __init__(self, session: Any, car: str) -> None:
        self._session, self._car = session, car
        self.relay: Relay | None = None
        """There is one where an event is of the link."""
        self.pids: dict[str, int] = {}
        self.start_controller: Callable[[], int] | None = None

    def set_link(self, to: Part, link: Link) -> None:
        if self.relay is not None:
            self.relay.set_way(_WAYS[to], link)

    def hold(self, to: Part) -> None:
        if self.relay is not None:
            self.relay.hold(_WAYS[to])

    def release(self, to: Part) -> None:
        if self.relay is not None:
            self.relay.release(_WAYS[to])

    def pause(self, part: Part, seconds: float) -> None:
        os.kill(self.pids[part], signal.SIGSTOP)
        later = threading.Timer(seconds, os.kill, (self.pids[part], signal.SIGCONT))
        later.daemon = True
        later.start()

    def kill(self) -> None:
        os.kill(self.pids["controller"], signal.SIGKILL)

    def start(self) -> None:
        if self.start_controller is not None:
            self.pids["controller"] = self.start_controller()

    def ask(self, service: Service[Any, A], request: Message | bytes, source: str = "") -> A:
        return ask(self._session, service, self._car, request, source)


def _let_happen(ready: Ready, processes: _Processes, over: threading.Event) -> None:
    """What happens, from the start of the run on; in a thread of its own."""
    while processes.status("plant").phase != "running":
        if over.wait(_LOOK_S):
            return
    begin_s = time.monotonic()
    for at_s, act in timeline(ready.scenario.event, ready.weights):
        if over.wait(max(begin_s + at_s - time.monotonic(), 0.0)):
            return
        act(processes)


def drive_real(ready: Ready, folder: Path) -> None:
    """Leaves ``run.mcap`` and the output of the processes in the folder of ``mpc.json``, and no
    process.

    InputError if a process does not start, or the run ends by anything but its laps or its time.
    """
    place = _running_elsewhere if ready.scenario.endpoints else _started
    car, first = ready.plant.car, ready.prepared.first
    about = {"drive": {"car": car_text(car), "track": first.track.name}}
    with place(ready, folder) as (session, processes):
        events: Publisher[Event] = Publisher(session, EVENT, car.name, "race")
        director = Director(session, car.name)
        director.wait_for(("plant", "controller"), 60.0)
        scene = Scene(car, first.track, first.line)
        with Recorder(session, car.name, folder / "run.mcap", about, scene=scene) as recorder:
            over = threading.Event()
            with ThreadPoolExecutor(1) as beside:
                happening = beside.submit(_let_happen, ready, processes, over)
                try:
                    execute(director, events, first.track, ready.plan, recorder)
                finally:
                    over.set()
            happening.result()
            time.sleep(SETTLING_S)


@contextmanager
def _running_elsewhere(ready: Ready, folder: Path) -> Iterator[tuple[Any, _Processes]]:
    endpoints = configured().endpoints("director", connect=list(ready.scenario.endpoints))
    with open_session(endpoints, "director") as session:
        yield session, _Processes(session, ready.plant.car.name)


@contextmanager
def _started(ready: Ready, folder: Path) -> Iterator[tuple[Any, _Processes]]:
    """Plant and controller, with a relay if their link is to fail."""
    scenario, name = ready.scenario, ready.plant.car.name
    on_link = [o for o in scenario.event if isinstance(o, LinkEvent | PartitionEvent)]
    with ExitStack() as stack:
        relay = None
        if on_link:
            udp = any(isinstance(one, LinkEvent) and one.reordered for one in on_link)
            at = [free_endpoint().replace("tcp", "udp" if udp else "tcp") for _ in range(2)]
            network = configured().plain(*at)
            relay = stack.enter_context(Relay(at[0]))
        else:
            network = stack.enter_context(private_network())
        plant, controller = _plant_options(ready, folder), _controller_options(ready, folder)
        if relay is not None:
            controller += ["--endpoint", relay.endpoint]
        system = stack.enter_context(started_system(name, folder, plant, configuration=network))
        stack.enter_context(system.controller(controller))
        beside = open_session(network.endpoints("director"), "director")
        processes = _Processes(stack.enter_context(beside), name)
        processes.relay = relay
        processes.pids = {part: one.pid for part, one in system.children.items()}
        again = ["--config", str(folder / CONFIGURATION), "--parent-pid", str(os.getpid())]
        processes.start_controller = lambda: (
            stack.enter_context(
                child(["controller", *controller, *again], folder / "controller-again.log")
            ).pid
        )
        yield system.session, processes


def _plant_options(ready: Ready, folder: Path) -> list[str]:
    settings, faults = ready.plant, folder / "faults.toml"
    write_car(folder / "car.toml", settings.car)
    race = ready.scenario.race.model_copy(update={"world": settings.world})
    pairs: list[tuple[str, object]] = [
        ("--rate", settings.rate_hz), ("--buffer", 1e3 * settings.buffer_s),
    ]  # fmt: skip
    if settings.faults:
        write_sensor_faults(faults, ready.scenario.faults)
        pairs.append(("--sensor-faults", faults))
    return [*plant_options(race, folder), *(str(one) for pair in pairs for one in pair)]


def _controller_options(ready: Ready, folder: Path) -> list[str]:
    settings, prepared = ready.controller, ready.prepared
    write_car(folder / "driven-car.toml", settings.car)
    pairs: list[tuple[str, object]] = [
        ("--car", folder / "driven-car.toml"), ("--artefact", prepared.artefacts[0]),
        ("--track", prepared.first.track_file), ("--raceline", prepared.first.line_file),
        ("--settings", folder / "mpc.json"), ("--rate", settings.rate_hz),
        ("--budget", settings.budget), ("--sensor-tolerance", settings.sensor_tolerance),
    ]  # fmt: skip
    if (weights := ready.first_weights) is not None:
        pairs.append(("--weights", weights))
    return [str(one) for pair in pairs for one in pair] + (["--hold"] if settings.hold else [])
