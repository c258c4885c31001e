"""Records a run, started here or running elsewhere, and analyses its log."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import claimed, write_whole
from bayesrace.messages import Event
from bayesrace.operation.preparation import prepare
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.system import Child, endings, started_system
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.recorder import Recorder
from bayesrace.studies.latency.analysis import Beside, LatencyResult, Memory, analyse
from bayesrace.studies.latency.beside import read_bare_loop, read_round_trips, running_beside
from bayesrace.studies.latency.report import RESULT, write_files
from bayesrace.studies.latency.settings import LatencySettings
from bayesrace.tracks import Track, load_track
from bayesrace.transport import Director, Item, Kind, open_session
from bayesrace.vehicles import write_car

__all__ = ["LatencyError", "Run", "measure"]

_LOG: Final = "run.mcap"

_ATTACH_S: Final = 10.0
_RUN_S: Final = 120.0
"""How long a system that is attached to may take to begin a run."""
_AFTERWARDS_S: Final = 60.0
"""The run's own time limit is this much later than its end by request."""
_LOOK_S: Final = 0.1
_SAMPLE_S: Final = 0.5
"""Between two samples of the memory of the processes."""
_MEMORY_S: Final = 60.0
"""Memory that a process takes in its first minute, or third of a shorter run, is no growth."""


class LatencyError(RuntimeError):
    """The measurement broke off."""


@dataclass
class Run(Beside):
    """A run while it is recorded, and what is known of it besides the log."""

    car: str = ""
    children: dict[str, Child] = field(default_factory=dict)
    """Plant and controller, if they were started here."""
    ended_early: str = ""
    error: BaseException | None = None
    """LatencyError or KeyboardInterrupt, if the recording ended early though it should not have."""

    def watch(self, director: Director, recorder: Recorder, begin_ns: int, end_ns: int) -> None:
        """Lets the time pass, until the run ends, a process started here ends, or a signal."""
        warm_ns = begin_ns + min(round(_MEMORY_S * 1e9), (end_ns - begin_ns) // 3)
        with director.inbox.receive_signals():
            while not self.ended_early and (left_ns := end_ns - time.monotonic_ns()) > 0:
                item = director.inbox.get(min(left_ns * 1e-9, _SAMPLE_S))
                if item is not None:
                    self._react(item)
                self.ended_early = self.ended_early or recorder.failed
                if time.monotonic_ns() >= warm_ns:
                    self.sample_memory()
            self.sample_memory()  # at least once: those before may have come late
        if self.ended_early and self.children and self.error is None:
            ended = [self.ended_early, *_endings(self.children)]
            self.error = LatencyError("; ".join(ended))
        self.notes += [f"ended early: {self.ended_early}"] if self.ended_early else []

    def _react(self, item: Item) -> None:
        if item.kind is Kind.SIGNAL:
            self.error, self.ended_early = KeyboardInterrupt(), "interrupted"
        elif isinstance(item.value, Event) and item.value.kind == "run_ended":
            self.ended_early = item.value.text
        elif item.kind is Kind.GONE:
            text = f"the {item.name} of car '{self.car}' vanished"
            self.ended_early = text if item.name in self.children else ""
            self.notes += [] if self.ended_early else [text]

    def sample_memory(self) -> None:
        """Samples the resident memory of the processes that were started here."""
        for name, process in self.children.items():
            with suppress(OSError, IndexError, ValueError):  # it is gone, or there is no /proc
                pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
                now = pages * os.sysconf("SC_PAGE_SIZE")
                before = self.rss.get(name, Memory(begin_bytes=now, most_bytes=now))
                most = max(now, before.most_bytes)
                self.rss[name] = before.model_copy(update={"most_bytes": most})


def measure(settings: LatencySettings, out: Path, stages: Stages) -> tuple[LatencyResult, Run]:
    """Records a run, or takes the log in the settings, and leaves the report's files in ``out``.

    Raises InputError for unusable settings, LatencyError if a process is lost before anything is
    measured; no process outlives the call.
    """
    if any((out / name).exists() for name in (RESULT, *(() if settings.log else (_LOG,)))):
        raise InputError(f"{out} holds a measurement already; choose another folder or remove it")
    track = load_track(settings.track, settings.car.width_m) if settings.track else None
    run = Run(car=settings.car_name)
    if settings.log is None:
        _record(run, settings, track, out, stages)
    with stages.stage("analyse the log"):
        try:
            analysis = analyse(settings.log or out / _LOG, settings, track, run)
        except InputError as error:
            raise run.error or error from None
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "settings.json", settings.model_dump_json(indent=1) + "\n")
        write_files(out, analysis)
    return analysis.result, run


def _record(
    run: Run, settings: LatencySettings, track: Track | None, out: Path, stages: Stages
) -> None:
    """Records the run, and the machine beside it."""
    with TemporaryDirectory(prefix="bayesrace-") as folder:
        rate_hz = _drive(run, settings, track, out, Path(folder), stages)
        run.bare = read_bare_loop(out, Path(folder), rate_hz)
        run.round_trip = read_round_trips(Path(folder), rate_hz)
    run.host = socket.gethostname()
    run.notes += [] if run.bare else ["no bare loop to compare the misses with: it was lost"]
    run.notes += [] if run.round_trip else ["no bare round trip of messages: it was lost"]


def _drive(
    run: Run,
    settings: LatencySettings,
    track: Track | None,
    out: Path,
    beside: Path,
    stages: Stages,
) -> float:
    """The rate of what has driven; ``beside`` has what was measured beside it."""
    files = None
    if settings.attach is None:
        files = prepare(
            PreparationSettings(car=settings.car), (settings.track,), stages,
            raceline=settings.raceline, weights=settings.weights, artefact=settings.artefact,
        )  # fmt: skip
    with ExitStack() as stack:
        stack.enter_context(claimed(out))
        with stages.stage("attach" if settings.attach else "start plant and controller"):
            stack.enter_context(_explained(run))
            if files is not None:
                write_car(out / "car.toml", settings.car)
                car, both = ["--car", str(out / "car.toml")], _options(settings)
                system = stack.enter_context(started_system(run.car, out, car, both))
                stack.enter_context(system.controller([*files.arguments, *car]))
                session, director, run.children = system.session, system.director, system.children
            elif settings.attach is not None:
                settings.attach.check_car(run.car)
                session = stack.enter_context(open_session(settings.attach, "director"))
                director = Director(session, run.car)
                director.wait_for(("plant", "controller"), _ATTACH_S)
                with stages.stage(f"wait for a run, {_RUN_S:g} s at most"):
                    _wait_for_run(director, run.car)
            rate_hz = director.status("controller").rate_hz
            count = round(settings.duration_s * rate_hz)
            # Before anything is recorded: it takes seconds to start.
            begin_at = stack.enter_context(
                running_beside(out, beside, settings.load, settings.realtime, rate_hz, count)
            )
            about = {"latency": {"settings": settings.model_dump_json()}}
            recorder = stack.enter_context(Recorder(session, run.car, out / _LOG, about))
            if track is not None and settings.attach is None:
                limit_s = settings.warm_up_s + settings.duration_s + _AFTERWARDS_S
                plan = RunPlan(1, "bayesrace", 0, limit_s, lockstep=False)
                director.start(run_request(track, plan))
                stack.callback(_stop, director)
        begin_ns = time.monotonic_ns() + round(settings.warm_up_s * 1e9)
        begin_at(begin_ns)
        with stages.stage(f"record {settings.duration_s:g} s"):
            run.watch(director, recorder, begin_ns, begin_ns + round(settings.duration_s * 1e9))
    return rate_hz


def _wait_for_run(director: Director, car: str) -> None:
    """Returns while a run in real time is driven; InputError if none begins in time."""
    deadline = time.monotonic() + _RUN_S
    while True:
        phase, rate_hz = director.status("plant").phase, director.status("controller").rate_hz
        if phase == "running" and rate_hz:
            return
        if time.monotonic() > deadline:
            raise InputError(
                f"car '{car}' does not drive in real time within {_RUN_S:g} s (plant: {phase}); "
                "start a run with 'bayesrace drive --mode realtime'"
            )
        time.sleep(_LOOK_S)


def _options(settings: LatencySettings) -> list[str]:
    """Those of plant and controller."""
    realtime = settings.realtime
    both = ["--name", settings.car_name, "--rate", repr(settings.rate_hz)]
    both += ["--lock-memory"] if realtime.lock_memory else []
    return both + (["--fifo", str(realtime.fifo)] if realtime.fifo else [])


def _stop(director: Director) -> None:
    with suppress(InputError):  # the plant may be what was lost
        director.stop("measured")


@contextmanager
def _explained(run: Run) -> Iterator[None]:
    """Adds the end of a child to what went wrong because of it."""
    try:
        yield
    except InputError as error:
        if _endings(run.children):
            raise LatencyError(str(error)) from error  # which says how they ended
        raise


def _endings(children: dict[str, Child]) -> list[str]:
    time.sleep(0.2)  # the system reports a death a moment after the network does
    return endings(children.values())
