"""A plant and a controller in simulated time, what happens to them, and runs of them."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, Self, TypeVar

from bayesrace import clock
from bayesrace.controller.interface import Controller
from bayesrace.controller.process import ControllerProcess
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.errors import InputError
from bayesrace.log import LogWriter
from bayesrace.messages import (
    EVENT,
    EVERYTHING,
    ROLLBACK,
    RUN,
    WEIGHTS,
    Event,
    Message,
    Service,
    car_key,
    decode,
    encode,
)
from bayesrace.operation.closed_loop import built_in_car
from bayesrace.operation.driving_system import DrivingSystem, Part
from bayesrace.operation.run_plan import RunPlan, announcement, run_request
from bayesrace.operation.simulation.network import Network, Session
from bayesrace.operation.simulation.scheduler import Scheduler, Task
from bayesrace.plant.process import PlantProcess
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.plant.vehicle import Vehicle
from bayesrace.realtime import uncollected
from bayesrace.tracks import Track
from bayesrace.transport.relay import IDEAL, Link
from bayesrace.transport.requests import in_transport_thread

__all__ = ["SimulatedSystem"]

A = TypeVar("A", bound=Message)

_EPOCH: Final = 1

_LOOK_S: Final = 1e-3
"""Between two looks for an answer."""
_PATIENCE_S: Final = 30.0
"""For judging weights, which takes real time."""
_OVERTIME_S: Final = 300.0
"""After a run's time limit; it has ended long before."""
_LOOK_US: Final = 15.0
"""From one look of the compiled step at its clock to the next."""


class SimulatedSystem(DrivingSystem):
    """A plant and a controller process on a simulated clock and network; ``with`` it.

    Only one at a time in a process: its clock is that of all loops. Messages are written to the
    ``log`` as a recorder's. All times are in simulated time, which passes in :meth:`drive`, in
    :meth:`sleep` and in requests.
    """

    def __init__(
        self,
        track: Track,
        make_controller: Callable[[], Controller],
        log: LogWriter,
        plant: PlantSettings | None = None,
        controller: ControllerSettings | None = None,
        *,
        vehicle: Vehicle | None = None,
        link: Link = IDEAL,
        seed: int = 0,
        look_us: float = _LOOK_US,
    ) -> None:
        """``make_controller``: of each controller process that is started. ``vehicle``: what plays
        the car; the built-in equations in ``plant.changes`` without. ``link``: each way between the
        two; ``seed``: of what is random about it. ``look_us``: simulated time from one look of the
        compiled step at its clock to the next. It looks once an iteration, so a step that takes
        more of them takes longer, and is cut short by its budget as in real time."""
        self._track, self._make_controller, self._log = track, make_controller, log
        self._plant = plant or PlantSettings()
        self._controller = controller or ControllerSettings(car=self._plant.car)
        self.car = self._plant.name or self._plant.car.name
        self._vehicle = vehicle or built_in_car(self._plant.car, self._plant.changes)
        self._look_ns = round(look_us * 1e3)
        self._scheduler = Scheduler()
        self._network = Network(self._scheduler, ("plant", "controller"), seed)
        self.ways = self._network.ways
        """Between the two, by who receives."""
        for way in self.ways.values():
            way.link = link
        self.controller: ControllerProcess | None = None
        """The one that runs, or ran last."""
        self._running: dict[str, tuple[Session, Task]] = {}
        self._timeline: list[tuple[float, Callable[[], object]]] = []
        self._ends: list[Event] = []
        self._runs = 0

    def __enter__(self) -> Self:
        self._clock = clock.simulated(self._scheduler)
        self._clock.__enter__()
        self._session = self._network.session("director")
        self._session.declare_subscriber(
            car_key(EVERYTHING, self.car), in_transport_thread(self._record)
        )
        self.start("plant")
        self.start("controller")
        return self

    def __exit__(self, *_: object) -> None:
        try:
            for name in tuple(self._running):
                self.kill(name)
            if self.controller is not None:
                self.controller.close()
        finally:
            self._clock.__exit__(None, None, None)

    # What happens to them ------------------------------------------------------------------------

    def start(self, part: Part = "controller") -> None:
        """Starts a process that does not run."""
        if part in self._running:
            raise InputError(f"the {part} runs already; kill it first")
        session = self._network.session(part)
        process = self._plant_on(session) if part == "plant" else self._controller_on(session)
        self._running[part] = session, self._scheduler.start(part, process.serve)
        self.sleep(0.01)

    def kill(self, part: str = "controller") -> None:
        """As SIGKILL; its links are closed at once."""
        session, task = self._process(part)
        del self._running[part]
        self._network.close(session)
        self._scheduler.end(task)

    def pause(self, part: Part, seconds: float) -> None:
        """As SIGSTOP, and SIGCONT after so long."""
        _, task = self._process(part)
        task.paused_until_ns = clock.monotonic_ns() + round(seconds * 1e9)

    def _process(self, part: str) -> tuple[Session, Task]:
        if part not in self._running:
            raise InputError(f"the {part} does not run; start it first")
        return self._running[part]

    def set_link(self, to: Part, link: Link) -> None:
        """What happens to messages for that process."""
        self.ways[to].link = link

    def hold(self, to: Part) -> None:
        """No message gets there any more."""
        self.ways[to].hold()

    def release(self, to: Part) -> None:
        """What has waited arrives."""
        self.ways[to].release()

    def ask(self, service: Service[Any, A], request: Message | bytes, source: str = "") -> A:
        """A request and its answer. InputError without any.

        Weights are judged in a thread that lives in real time, during which no simulated time
        passes; the control loop takes them between two cycles.
        """
        data = request if isinstance(request, bytes) else encode(request)
        try:
            query = self._network.ask(car_key(service.key, self.car, source), data)
        except KeyError:
            raise InputError(f"no process answers '{service.name}'; start it") from None
        adoption = self.controller._adoption if self.controller else None
        judged = service in (WEIGHTS, ROLLBACK)
        now, patience_s = clock.monotonic, service.timeout_s
        if judged:
            now, patience_s = time.monotonic, _PATIENCE_S
        give_up_s = now() + patience_s
        while query.answer is None:
            if now() > give_up_s:
                raise InputError(f"no answer to '{service.name}' within {patience_s:g} s")
            if judged and not (adoption and adoption.tasks):
                time.sleep(_LOOK_S)
            else:
                self.sleep(_LOOK_S)
        return decode(service.answer, query.answer)

    # Runs ----------------------------------------------------------------------------------------

    def at(self, time_s: float, action: Callable[[], object]) -> None:
        """Does that in the next run, so long after its start."""
        self._timeline.append((time_s, action))

    def drive(self, plan: RunPlan) -> Event:
        """One run: its end. InputError if the plant refuses it, or does not end it in time."""
        weights = self.controller and self.controller._driver.controller.weights_version
        self._tell(announcement(plan, self._runs, weights or ""))
        self._runs += 1
        self._ends.clear()
        with uncollected():
            reply = self.ask(RUN, run_request(self._track, plan))
            if not reply.accepted:
                raise InputError(f"the plant refuses the run: {reply.text}")
            begin_s = clock.monotonic()
            for time_s, action in sorted(self._timeline, key=lambda one: one[0]):
                if not self._sleep_in_run(begin_s + time_s):
                    break
                action()
            self._timeline.clear()
            self._sleep_in_run(begin_s + plan.max_time_s + _OVERTIME_S)
        self._check()
        if not self._ends:
            raise InputError(f"run {plan.run} did not end")
        return self._ends[-1]

    def sleep(self, seconds: float) -> None:
        """Lets simulated time pass."""
        clock.sleep(seconds)
        self._check()

    def _sleep_in_run(self, until_s: float) -> bool:
        """False if the run has ended before."""
        while not self._ends and (left_s := until_s - clock.monotonic()) > 0:
            clock.sleep(min(left_s, 20 * _LOOK_S))
            self._check()
        return not self._ends

    # Processes -----------------------------------------------------------------------------------

    def _plant_on(self, session: Session) -> PlantProcess:
        return PlantProcess(session, self._plant, self._vehicle, _EPOCH)

    def _controller_on(self, session: Session) -> ControllerProcess:
        if self.controller is not None:
            self.controller.close()
        process = ControllerProcess(session, self._controller, self._make_controller())
        self.controller = process
        process._driver.live_by(partial(self._scheduler.work_s, self._look_ns))
        return process

    def _check(self) -> None:
        """Raises what a process has failed with."""
        for name, (_, task) in self._running.items():
            if task.error is not None:
                raise RuntimeError(f"simulated {name}: {task.error!r}") from task.error

    # Recording -----------------------------------------------------------------------------------

    def _tell(self, event: Event) -> None:
        self._log.write(car_key(EVENT.key, self.car, "race"), encode(event), event.source_time_ns)

    def _record(self, sample: Any) -> None:
        data = sample.to_bytes()
        self._log.write(sample.key_expr, data, self._scheduler.monotonic_ns())
        if sample.key_expr == car_key(EVENT.key, self.car, "plant"):
            event = decode(Event, data)
            if event.kind == "run_ended":
                self._ends.append(event)
