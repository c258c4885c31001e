"""A plant and a controller in simulated time, what happens to them, and runs of them."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, Literal, Self, TypeVar

from bayesrace import clock
from bayesrace.controller.interface import Controller
from bayesrace.controller.process import ControllerProcess
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.errors import InputError
from bayesrace.log import LogWriter
from bayesrace.messages import (
    COMMAND,
    EVENT,
    EVERYTHING,
    ROLLBACK,
    RUN,
    STATUS,
    WEIGHTS,
    Command,
    Event,
    Message,
    Reply,
    RollbackRequest,
    Service,
    Status,
    StatusRequest,
    car_key,
    decode,
    encode,
)
from bayesrace.operation.closed_loop import built_in_car
from bayesrace.operation.run_plan import RunPlan, announcement, run_request
from bayesrace.operation.simulation.network import Direction, Network, Query, Session
from bayesrace.operation.simulation.scheduler import Scheduler, Task
from bayesrace.plant.process import PlantProcess
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.plant.vehicle import Vehicle
from bayesrace.realtime import uncollected
from bayesrace.tracks import Track
from bayesrace.transport.relay import IDEAL, Link
from bayesrace.transport.requests import in_transport_thread

__all__ = ["Part", "SimulatedSystem"]

A = TypeVar("A", bound=Message)

Part = Literal["plant", "controller"]

_PLANT: Final = "plant"
_CONTROLLER: Final = "controller"
_EPOCH: Final = 1
_REASON: Final = "asked for"

_LOOK_NS: Final = 1_000_000
"""Between two looks for an answer, or for the end of a run."""
_PATIENCE_S: Final = 30.0
"""For work that takes real time, such as judging weights."""
_OVERTIME_S: Final = 300.0
"""After a run's time limit; it has ended long before."""
_LOOK_US: Final = 15.0
"""From one look of the compiled step at its clock to the next."""


class SimulatedSystem:
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
        self._network = Network(self._scheduler, (_PLANT, _CONTROLLER), seed)
        self.ways: dict[Part, Direction] = {
            _CONTROLLER: self._network.ways[_PLANT, _CONTROLLER],
            _PLANT: self._network.ways[_CONTROLLER, _PLANT],
        }
        """Between the two, by who receives; set their ``link``, ``hold`` and ``release`` them."""
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
        self.start(_PLANT)
        self.start(_CONTROLLER)
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

    def start(self, part: str) -> None:
        """Starts a process that does not run."""
        if part in self._running:
            raise InputError(f"the {part} runs already; kill it first")
        session = self._network.session(part)
        run = self._started_plant if part == _PLANT else self._started_controller
        process = run(session)
        self._running[part] = session, self._scheduler.start(part, process.serve)
        self.sleep(0.01)

    def kill(self, part: str) -> None:
        """As SIGKILL; its links are closed at once."""
        if part not in self._running:
            raise InputError(f"the {part} does not run; start it first")
        session, task = self._running.pop(part)
        self._network.close(session)
        self._scheduler.end(task)

    def pause(self, part: str, seconds: float) -> None:
        """As SIGSTOP, and SIGCONT after so long."""
        if part not in self._running:
            raise InputError(f"the {part} does not run; start it first")
        self._running[part][1].paused_until_ns = clock.monotonic_ns() + round(seconds * 1e9)

    def stop(self) -> Reply:
        """The controller slows the car down to standstill."""
        return self._command("stop")

    def go(self) -> Reply:
        """The controller drives again."""
        return self._command("go")

    def _command(self, command: str) -> Reply:
        now_ns = clock.monotonic_ns()
        request = Command(seq=0, source_time_ns=now_ns, command=command, text=_REASON)
        return self.ask(COMMAND, request)

    def publish(self, weights: bytes) -> Reply:
        """New weights for the controller: its answer, when they are in use or refused. Judging them
        takes real time, and none of the simulation's."""
        return self._judged(self._asked(WEIGHTS, weights))

    def roll_back(self) -> Reply:
        """Back to the weights before."""
        request = RollbackRequest(seq=0, source_time_ns=clock.monotonic_ns(), text=_REASON)
        return self._judged(self._asked(ROLLBACK, encode(request)))

    def _judged(self, query: Query) -> Reply:
        """The answer of the controller's thread for weights, which lives in real time."""
        controller = self.controller
        adoption = None if controller is None else controller._adoption
        give_up = time.monotonic() + _PATIENCE_S
        while query.answer is None:
            if adoption is not None and adoption.tasks:
                self.sleep(1e-3)  # the control loop takes them between two cycles
            elif time.monotonic() > give_up:
                raise InputError(f"no answer about weights within {_PATIENCE_S:g} s")
            else:
                time.sleep(1e-3)
        return decode(Reply, query.answer)

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

    def status(self, part: str) -> Status:
        """Of a process, as it answers."""
        request = StatusRequest(seq=0, source_time_ns=clock.monotonic_ns())
        return self.ask(STATUS, request, part)

    def sleep(self, seconds: float) -> None:
        """Lets simulated time pass."""
        clock.sleep(seconds)
        self._check()

    def _sleep_in_run(self, until_s: float) -> bool:
        """False if the run has ended before."""
        while not self._ends and (left_s := until_s - clock.monotonic()) > 0:
            clock.sleep(min(left_s, 1e-9 * 20 * _LOOK_NS))
            self._check()
        return not self._ends

    def ask(self, service: Service[Any, A], message: Message, source: str = "") -> A:
        """A request and its answer. InputError without any."""
        query = self._asked(service, encode(message), source)
        give_up_s = clock.monotonic() + service.timeout_s
        while query.answer is None:
            if clock.monotonic() > give_up_s:
                raise InputError(f"no answer to '{service.name}' within {service.timeout_s:g} s")
            self.sleep(_LOOK_NS * 1e-9)
        return decode(service.answer, query.answer)

    def _asked(self, service: Service[Any, Any], data: bytes, source: str = "") -> Query:
        try:
            return self._network.ask(car_key(service.key, self.car, source), data)
        except KeyError:
            raise InputError(f"nobody serves '{service.name}'; start the process") from None

    # Processes -----------------------------------------------------------------------------------

    def _started_plant(self, session: Session) -> PlantProcess:
        return PlantProcess(session, self._plant, self._vehicle, _EPOCH)

    def _started_controller(self, session: Session) -> ControllerProcess:
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
