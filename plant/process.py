"""The plant process: waits for a request, drives the run, reports its end, waits for the next."""

import gc
import logging
import secrets
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import Any

from bayesrace import clock
from bayesrace.errors import InputError
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    EVENT,
    GO_ON,
    RUN,
    STATE,
    STATUS,
    STOP,
    TRUTH,
    Event,
    Numbering,
    RunRequest,
    Scalar,
    Status,
)
from bayesrace.plant.car import End
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.plant.run import CONTROLLER_LOST, Run, RunCounters
from bayesrace.plant.vehicle import Compile, FmuFault, Vehicle, open_vehicle
from bayesrace.processes import die_with_parent
from bayesrace.realtime import prepare_thread, suspension
from bayesrace.transport import (
    HEARTBEAT_S,
    NEWEST,
    Heartbeat,
    Inbox,
    Item,
    Kind,
    Publisher,
    Request,
    decode_request,
    open_sessions,
)
from bayesrace.transport.hold import HoldWatch

__all__ = ["PlantProcess", "PlantSettings", "main"]

_log = logging.getLogger("bayesrace.plant")

_ABANDONED_S = 10.0
"""A run ends when its director has been gone for so long; a link may come back before."""

_SPARE_S = 2.0
"""How long after a run the next one may follow, which links that are opened anew would hold up."""

_PAUSE_S = 600.0
"""A run that waits for so long to go on ends."""

_RELINKED_S = 2.0
"""After a suspension links are there again in less."""


class PlantProcess:
    """Serves one car's runs over an open session."""

    def __init__(
        self, session: Any, settings: PlantSettings, vehicle: Vehicle, epoch: int | None = None
    ) -> None:
        """``epoch``: of its states; None: a random one, as two processes' must differ."""
        self._settings = settings
        self.name = settings.name or settings.car.name
        self._simulator = vehicle
        # Two processes started in one nanosecond on two machines must differ too.
        self._epoch = secrets.randbits(62) if epoch is None else epoch
        self._numbering = Numbering()
        self._heartbeat = Heartbeat(session, self.name, "plant")
        self._states = Publisher(session, STATE, self.name)
        self._truths = Publisher(session, TRUTH, self.name)
        self._events = Publisher(session, EVENT, self.name, "plant")
        self._counters = RunCounters()
        self._hold = HoldWatch(session, self.name)
        self._run: Run | None = None
        self._run_number = 0
        self._runs = 0
        self._text = f"no run so far with {_played_by(settings, vehicle)}"
        self._stopping = self._waits = False
        self._spare_s = 0.0
        """From when on links may be opened anew."""
        self._director_gone_ns: int | None = None
        """Since when the director is gone; None: it is there, or never was."""
        self._news: tuple[float, str, dict[str, Scalar]] | None = None
        """When and what to report of a suspension: links that have expired are there again by
        then."""
        inbox = self.inbox = Inbox(session, self.name)
        self._decoder = inbox.subscribe(ACTUATION, newest=NEWEST, logger=_log)
        inbox.subscribe(BRAKING, newest=1, logger=_log)
        for service in (RUN, STOP, GO_ON):
            inbox.serve(service)
        inbox.serve(STATUS, "plant")
        inbox.watch("controller")
        inbox.watch("director")
        inbox.announce("plant")

    def serve(self, renewed: Callable[[], Any] = lambda: None) -> None:
        """Until SIGINT or SIGTERM; ``renewed``: :meth:`.Sessions.renewed`, between runs."""
        while not self._stopping:
            if clock.monotonic() > self._spare_s and (session := renewed()) is not None:
                publishers = self._heartbeat, self._states, self._truths, self._events
                for one in (*publishers, self._hold, self.inbox):
                    one.bind(session)
            self._beat()
            item = self.inbox.get(HEARTBEAT_S)
            if item is None:
                continue
            if item.kind is Kind.MESSAGE:  # not used, but received
                self._overheard(item)
                continue
            if item.kind is Kind.REQUEST and item.name == RUN.name:
                self._serve_run(item.value)
            else:
                self._react(item)

    def _serve_run(self, request: Request) -> None:
        """Check and answer the request, then drive the run."""
        message, why_not = decode_request(request)
        if message is not None:
            why_not = self._prepare(message)
        by = request.by
        request.reply(not why_not, why_not or f"run {message.run} started")
        if why_not or self._run is None:
            _log.warning("run refused: %s", why_not)
            return
        self._text = f"run {message.run} is running"
        mode = "lockstep" if message.lockstep else "free-running"
        self._publish_event("run_started", f"run {message.run} in {mode}", {"mode": mode, **by})
        gc.collect()
        end = self._run.execute()
        self._conclude(message, end)
        self._spare_s = clock.monotonic() + _SPARE_S

    def _prepare(self, message: RunRequest) -> str:
        """Make the run; returns why it cannot be, or ""."""
        self._director_gone_ns = None  # of a run before
        if message.pause_s and not message.lockstep:
            return "a run in real time does not wait: leave out pause_s, or drive in lockstep"
        if self._settings.endpoints.low_latency and not message.lockstep:
            # Without priorities a message that Zenoh drops may be the last of its kind on a link.
            return (
                "this plant was started for lockstep (--low-latency): "
                "start it without to drive in real time"
            )
        if message.lockstep and self._simulator.real:
            return "a real car does not wait for its controller: drive with --mode realtime"
        if message.held and message.lockstep:
            return "hold-to-run is for real time (--mode realtime): lockstep waits for its director"
        if self._settings.hold_to_run and not message.held:
            return "only held runs here (hold_to_run): drive with --mode realtime --hold-to-run"
        if message.lockstep and not self._controller_there():
            return (
                f"no controller for car '{self.name}': start one that connects to this plant "
                "(bayesrace controller)"
            )
        if (count := len(self.inbox.nodes("controller"))) > 1:
            # Their actuations could not be distinguished.
            return f"{count} controllers drive car '{self.name}'; end all but one"
        try:
            self._run = Run(
                request=message,
                simulator=self._simulator,
                inbox=self.inbox,
                states=self._states,
                truths=self._truths,
                decoder=self._decoder,
                counters=self._counters,
                numbering=self._numbering,
                react=self._react,
                beat=self._beat,
                pause=self._pause,
                suspended=self._suspended,
                hold=self._hold,
                epoch=self._epoch,
                delay_s=self._settings.delay_s,
                buffer_s=self._settings.buffer_s,
                sensors=self._settings.instruments,
                seed=self._settings.seed,
                faults=self._settings.faults,
            )
        except (InputError, FmuFault) as error:
            return str(error)
        self._hold.follow((self._epoch, message.run), message.held)
        self._run_number = message.run
        self._runs += 1
        return ""

    def _overheard(self, item: Item) -> None:
        """Count an actuation that arrives when no run drives; it has no effect."""
        if item.value is not None and item.name == ACTUATION.name:
            self._numbering.note(item.value.seq)

    def _controller_there(self) -> bool:
        deadline = clock.monotonic() + self._settings.controller_wait_s
        while "controller" not in self.inbox.alive:
            left_s = deadline - clock.monotonic()
            if left_s <= 0 or self._stopping:
                return False
            item = self.inbox.get(left_s)
            if item is not None and item.kind is Kind.MESSAGE:
                self._overheard(item)
            elif item is not None:
                self._react(item)
        return True

    def _conclude(self, message: RunRequest, end: End) -> None:
        run = self._run
        self._run = None
        if run is None:
            return
        count = len(self.inbox.nodes("controller"))
        if end.reason in ("laps", "max_time") and count > 1:
            words = f"{end.text}, but {count} controllers drove the car"
            end = End("several_controllers", words)
        self._text = f"run {message.run} ended after {run.time_s:.2f} s: {end.text}"
        # A fault is the FMU's, and its last message is in the text.
        level = logging.ERROR if end.reason == "plant_fault" else logging.INFO
        _log.log(level, "%s", self._text)
        data: dict[str, Scalar] = {
            "reason": end.reason,
            "time_s": run.time_s,
            "laps": run.laps,
            **self._count(),
        }
        self._publish_event("run_ended", self._text, data)

    def _react(self, item: Item) -> End | None:
        """Everything that may happen at any time; what it returns ends the current run."""
        if item.kind is Kind.SIGNAL:
            self._stopping = True
            return End("interrupted", "the plant process was asked to end")
        if item.name == "director":
            self._director_gone_ns = item.received_ns if item.kind is Kind.GONE else None
        elif item.kind is Kind.GONE:
            _log.warning("the controller of car '%s' is gone", self.name)
        elif item.kind is Kind.REQUEST:
            return self._serve(item.value)
        return None

    def _serve(self, request: Request) -> End | None:
        if request.service is RUN:
            request.reply(False, f"busy: {self._text}; 'bayesrace stop --run' ends it")
            return None
        if request.service is STATUS:
            request.answer(self._status())
            return None
        message, why_not = decode_request(request)
        if request.service is GO_ON:
            waited = message is not None and self._waits and message.run == self._run_number
            self._waits &= not waited
            words = f"run {self._run_number} goes on" if waited else f"none to go on: {self._text}"
            request.reply(waited, why_not or words)
            return None
        if message is None or self._run is None:
            request.reply(False, why_not or "no run to stop")
            return None
        of = f" of '{request.sender}'" if request.sender else ""
        request.reply(True, f"run {self._run_number} stops")
        return End("stopped", f"stopped on request{of}: {message.text}")

    def _pause(self, time_s: float) -> End | None:
        """Reports that the run waits, and waits until it may go on; returns what ends it."""
        running, self._text = self._text, f"run {self._run_number} waits at {time_s:.2f} s"
        self._waits = True
        self._publish_event("pause", self._text, {"time_s": time_s})
        deadline = clock.monotonic() + _PAUSE_S
        end: End | None = None
        while self._waits and end is None:
            item = self.inbox.get(HEARTBEAT_S)
            if item is not None and item.kind is Kind.GONE and item.name == "controller":
                end = CONTROLLER_LOST
            elif item is not None and item.kind is Kind.MESSAGE:
                self._overheard(item)
            elif item is not None:
                end = self._react(item)
            if end is None and clock.monotonic() > deadline:
                end = End("abandoned", f"the run waited {_PAUSE_S:g} s in a pause: no go_on came")
            end = end or self._beat()
        self._waits, self._text = False, running
        return end

    def _publish_event(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        now_ns = clock.monotonic_ns()
        event = Event(
            seq=self._events.next_seq,
            source_time_ns=now_ns,
            run=self._run_number,
            source="plant",
            kind=kind,
            text=text[:2000],
            data=data,
        )
        self._events.put(event, lockstep=True)

    def _count(self) -> dict[str, Scalar]:
        return {
            "runs": self._runs,
            "refused": self._decoder.refused + self._hold.decoder.refused,
            "overflowed": self.inbox.overflowed,
            "requests_rejected": self.inbox.requests_rejected,
            "states_sent": self._states.next_seq,
            "actuations_received": self._numbering.received,
            "actuations_lost": self._numbering.lost,
            **asdict(self._counters),
            **asdict(self._simulator.guard.counters),
        }

    def _suspended(self, seconds: float) -> None:
        text = f"{suspension(seconds)}; the run goes on where it was"
        _log.warning("%s", text)
        self._news = clock.monotonic() + _RELINKED_S, text, {"seconds": seconds}

    def _beat(self) -> End | None:
        """Publishes the status when it is due; returns what ends the current run, if anything."""
        self._heartbeat.beat(self._status)
        if self._news is not None and clock.monotonic() > self._news[0]:
            _, text, data = self._news
            self._news = None
            self._publish_event("suspended", text, data)
        gone_ns = self._director_gone_ns
        if gone_ns is not None and clock.monotonic_ns() - gone_ns >= _ABANDONED_S * 1e9:
            gone = "the process that started the run has been gone"
            return End("abandoned", f"{gone} for {_ABANDONED_S:g} s")
        return None

    def _status(self, seq: int = 0) -> Status:
        phase = "idle" if self._run is None else "running"
        now_ns = clock.monotonic_ns()
        return Status(
            seq=seq,
            source_time_ns=now_ns,
            source="plant",
            phase=phase,
            epoch=self._epoch,
            run=self._run_number,
            text="; ".join(filter(None, (self._text, self._simulator.report())))[:2000],
            weights_version="",
            track="",
            rate_hz=self._settings.rate_hz,
            state_age_s=-1.0
            if self._states.sent_ns is None
            else (now_ns - self._states.sent_ns) * 1e-9,
            delay_s=self._settings.delay_s,
            counters=self._count(),
            **self.inbox.presence(self._settings.endpoints, "controller"),
        )


def _played_by(settings: PlantSettings, vehicle: Vehicle) -> str:
    if vehicle.real:
        return "a real car"
    if settings.fmu is not None:
        return f"FMU {settings.fmu.name}"
    return "the built-in car" if settings.simulator == "equations" else settings.simulator


def main(
    settings: PlantSettings, compiled: Compile | None = None, hardware: Vehicle | None = None
) -> int:
    """Run a plant until SIGINT or SIGTERM; returns the exit code. Raises InputError at a bad start.

    ``compiled``: of the car's equations, see :class:`bayesrace.plant.simulator.Simulator`.
    ``hardware``: the real car (:class:`bayesrace.plant.hardware.Hardware`), which is open, instead
    of a simulated one.
    Call it from the main thread of a process: it takes over the signals.
    """
    die_with_parent(settings.parent_pid)
    vehicles: AbstractContextManager[Vehicle]
    vehicles = nullcontext(hardware) if hardware else open_vehicle(
        settings.car, settings.fmu, settings.fmu_map, settings.rate_hz, compiled,
        simulator=settings.simulator, world=settings.changes,
    )  # fmt: skip
    if hardware is not None and (settings.delay_s or settings.changes.root):
        raise InputError("a real car has delays and a world of its own: leave out delay_s, world")
    if hardware is not None and settings.sensor_faults:
        raise InputError("sensors of a real car fail by themselves: leave out sensor_faults")
    settings.endpoints.check_car(settings.name or settings.car.name)
    with vehicles as vehicle, open_sessions(settings.endpoints, "plant") as sessions:
        process = PlantProcess(sessions.current, settings, vehicle)
        for refusal in prepare_thread(settings.realtime):
            _log.warning("%s", refusal)
        where = ", ".join(settings.endpoints.listen)
        _log.info(
            "plant of car '%s', %s, on %s", process.name, _played_by(settings, vehicle), where
        )
        with process.inbox.receive_signals():
            process.serve(sessions.renewed)
    return 0
