"""A scenario in real time: a plant and a controller process, with a relay between them where their
link is to fail; or processes that were started elsewhere."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from bayesrace.configuration import Configuration, configured
from bayesrace.files import read_whole, write_whole
from bayesrace.messages import COMMAND, EVENT, STATUS, Command, Event, StatusRequest
from bayesrace.operation.drive import execute
from bayesrace.operation.simulation.system import Part
from bayesrace.operation.system import CONFIGURATION, child, private_network, started_system
from bayesrace.plant.faults import write_sensor_faults
from bayesrace.plant.world import write_world
from bayesrace.recorder import Recorder
from bayesrace.sensors import write_sensors
from bayesrace.studies.evidence.scenario.events import LinkEvent, PartitionEvent, timeline
from bayesrace.studies.evidence.scenario.preparing import Ready
from bayesrace.studies.evidence.scenario.simulated import SETTLING_S
from bayesrace.transport import (
    Director,
    Publisher,
    ask,
    free_endpoint,
    open_session,
    send_rollback,
    send_weights,
)
from bayesrace.transport.relay import Link, Relay
from bayesrace.vehicles import car_text, write_car

__all__ = ["drive_real"]

_LOOK_S: Final = 0.005
_REASON: Final = "a scenario"
_WAYS: Final = {"controller": "forth", "plant": "back"}
"""Of the relay, whose target is the plant, by who receives."""


class _Processes:
    """Processes as :class:`.events.System`, over a session of its own."""

    def __init__(self, session: Any, car: str) -> None:
        self._session, self._car = session, car
        self.relay: Relay | None = None
        self.pids: dict[str, int] = {}
        self.start_controller: Any = None

    def _link(self) -> Relay:
        assert self.relay is not None  # noqa: S101 (there is one where a link event is)
        return self.relay

    def set_link(self, to: Part, link: Link) -> None:
        self._link().set_way(_WAYS[to], link)

    def hold(self, to: Part) -> None:
        self._link().hold(_WAYS[to])

    def release(self, to: Part) -> None:
        self._link().release(_WAYS[to])

    def pause(self, part: Part, seconds: float) -> None:
        os.kill(self.pids[part], signal.SIGSTOP)
        later = threading.Timer(seconds, os.kill, (self.pids[part], signal.SIGCONT))
        later.daemon = True
        later.start()

    def kill(self) -> None:
        os.kill(self.pids["controller"], signal.SIGKILL)

    def restart(self) -> None:
        self.pids["controller"] = self.start_controller()

    def stop(self) -> object:
        return self._command("stop")

    def go(self) -> object:
        return self._command("go")

    def _command(self, command: str) -> object:
        now_ns = time.monotonic_ns()
        request = Command(seq=0, source_time_ns=now_ns, command=command, text=_REASON)
        return ask(self._session, COMMAND, self._car, request)

    def publish(self, weights: Path) -> object:
        return send_weights(self._session, self._car, read_whole(weights, "the weights"))

    def roll_back(self) -> object:
        return send_rollback(self._session, self._car, _REASON)

    @property
    def running(self) -> bool:
        """Whether the run has begun."""
        request = StatusRequest(seq=0, source_time_ns=time.monotonic_ns())
        return ask(self._session, STATUS, self._car, request, "plant").phase == "running"


class _Timeline(threading.Thread):
    """Lets happen what happens, from the start of the run on."""

    def __init__(self, ready: Ready, processes: _Processes) -> None:
        super().__init__(daemon=True)
        self._ready, self._processes = ready, processes
        self._over = threading.Event()
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            while not self._over.wait(_LOOK_S) and not self._processes.running:
                pass
            begin_s, acted_on = time.monotonic(), self._processes
            for at_s, act in timeline(self._ready.scenario.event, self._ready.weights):
                if self._over.wait(max(begin_s + at_s - time.monotonic(), 0.0)):
                    return
                act(acted_on)
        except Exception as error:
            self.error = error

    def finish(self) -> None:
        """Ends it; raises what went wrong."""
        self._over.set()
        self.join(30.0)
        if self.error is not None:
            raise self.error


def drive_real(ready: Ready, folder: Path) -> None:
    """Leaves ``run.mcap`` and the output of the processes in the folder, and no process.

    InputError if a process does not start, or the run ends by anything but its laps or its time.
    """
    place = _running_elsewhere if ready.scenario.endpoints else _started
    car, first = ready.plant.car, ready.prepared.first
    about = {"drive": {"car": car_text(car), "track": first.track.name}}
    with place(ready, folder) as (session, processes):
        events: Publisher[Event] = Publisher(session, EVENT, car.name, "race")
        director = Director(session, car.name)
        director.wait_for(("plant", "controller"), 60.0)
        with Recorder(session, car.name, folder / "run.mcap", about) as recorder:
            happening = _Timeline(ready, processes)
            happening.start()
            try:
                execute(director, events, first.track, ready.plan, recorder)
            finally:
                happening.finish()
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
        processes = _Processes(_looking_on(stack, network), name)
        processes.relay = relay
        processes.pids = {part: one.pid for part, one in system.children.items()}
        again = ["--config", str(folder / CONFIGURATION), "--parent-pid", str(os.getpid())]
        processes.start_controller = lambda: (
            stack.enter_context(
                child(["controller", *controller, *again], folder / "controller-again.log")
            ).pid
        )
        yield system.session, processes


def _looking_on(stack: ExitStack, network: Configuration) -> Any:
    """A session for the thread of the time line."""
    return stack.enter_context(open_session(network.endpoints("director"), "director"))


def _plant_options(ready: Ready, folder: Path) -> list[str]:
    settings = ready.plant
    pairs: list[tuple[str, object]] = [
        ("--car", folder / "car.toml"), ("--rate", settings.rate_hz), ("--seed", settings.seed),
        ("--simulator", settings.simulator), ("--delay", 1e3 * settings.delay_s),
        ("--buffer", 1e3 * settings.buffer_s),
        ("--sensors", folder / "sensors.toml" if settings.instruments.root else "exact"),
    ]  # fmt: skip
    write_car(folder / "car.toml", settings.car)
    if settings.instruments.root:
        write_sensors(folder / "sensors.toml", settings.instruments)
    if settings.changes.root:
        write_world(folder / "world.toml", settings.changes)
        pairs.append(("--world", folder / "world.toml"))
    if settings.faults:
        write_sensor_faults(folder / "faults.toml", ready.scenario.faults)
        pairs.append(("--sensor-faults", folder / "faults.toml"))
    pairs += [(o, f) for o, f in (("--fmu", settings.fmu), ("--map", settings.fmu_map)) if f]
    return [str(one) for pair in pairs for one in pair]


def _controller_options(ready: Ready, folder: Path) -> list[str]:
    settings, prepared = ready.controller, ready.prepared
    write_whole(folder / "mpc.json", ready.scenario.mpc.model_dump_json(indent=1) + "\n")
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
