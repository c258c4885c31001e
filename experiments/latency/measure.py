"""Records a run, started here or running elsewhere, and has its log analysed."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.messages import Event
from bayesrace.recorder import Recorder
from bayesrace.tracks import load_track
from bayesrace.transport import Director, Endpoints, Item, Kind, free_endpoint, open_session
from bayesrace.vehicles import write_car
from experiments.drive import RunPlan, run_request, wait_for_both
from experiments.latency.analysis import Beside, analyse
from experiments.latency.beside import read_bare_loop, running_beside
from experiments.latency.report import RESULT, write_files
from experiments.latency.results import LatencyResult, Memory
from experiments.latency.settings import LatencySettings
from experiments.preparation import prepare
from experiments.processes import Child, child, endings
from experiments.progress import Stages
from experiments.settings import PreparationSettings

__all__ = ["LatencyError", "Run", "measure"]

_START_S: Final = 60.0
"""For processes to start on a machine that is busy."""
_ATTACH_S: Final = 10.0
_AFTERWARDS_S: Final = 60.0
"""The run's own time limit is this much later than its end by request."""
_LOOK_S: Final = 0.5
"""Between two looks at the memory of the processes."""
_MEMORY_S: Final = 60.0
"""Memory that a process takes in its first minute, or third of a shorter run, is no growth."""


class LatencyError(RuntimeError):
    """The measurement broke off."""


@dataclass
class Run:
    """A run while it is recorded, and what is known of it then besides the log."""

    settings: LatencySettings
    children: dict[str, Child] = field(default_factory=dict)
    """Plant and controller, if they were started here."""
    rss: dict[str, Memory] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    ended_early: str = ""
    interrupted: bool = False

    def raise_if_broken(self) -> None:
        """KeyboardInterrupt or LatencyError, if the recording ended early though it should not."""
        if self.interrupted:
            raise KeyboardInterrupt
        if self.ended_early and not self.settings.attach:
            raise LatencyError(self.ended_early)

    def endings(self) -> list[str]:
        """How the processes ended that have."""
        time.sleep(0.2)  # the system reports a death a moment after the network does
        return endings(self.children.values())

    def watch(self, director: Director, recorder: Recorder, begin_ns: int, end_ns: int) -> None:
        """Lets the time pass, until the run ends, a process started here ends, or a signal."""
        warm_ns = begin_ns + min(round(_MEMORY_S * 1e9), (end_ns - begin_ns) // 3)
        with director.inbox.catching_signals():
            while not self.ended_early and (left_ns := end_ns - time.monotonic_ns()) > 0:
                item = director.inbox.get(min(left_ns * 1e-9, _LOOK_S))
                if item is not None:
                    self._react(item)
                self.ended_early = self.ended_early or recorder.failed
                if time.monotonic_ns() >= warm_ns:
                    self.look_at_memory()
            self.look_at_memory()  # at least once: the looks before may have come late

    def _react(self, item: Item) -> None:
        if item.kind is Kind.SIGNAL:
            self.interrupted, self.ended_early = True, "interrupted"
        elif item.kind is Kind.GONE:
            text = f"the {item.name} of car '{self.settings.car_name}' vanished"
            if item.name in self.children:
                self.ended_early = "; ".join([text, *self.endings()])
            else:
                self.notes.append(text)
        elif isinstance(item.value, Event) and item.value.kind == "run_ended":
            self.ended_early = item.value.text

    def look_at_memory(self) -> None:
        """Takes note of the resident memory of the processes that were started here."""
        for name, process in self.children.items():
            with suppress(OSError, IndexError, ValueError):  # it is gone, or there is no /proc
                pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
                now = pages * os.sysconf("SC_PAGE_SIZE")
                begin = self.rss.get(name, Memory(begin_bytes=now, most_bytes=now))
                most = max(now, begin.most_bytes)
                self.rss[name] = Memory(begin_bytes=begin.begin_bytes, most_bytes=most)


def measure(settings: LatencySettings, out: Path, stages: Stages) -> tuple[LatencyResult, Run]:
    """Records a run, or takes the log in the settings, and leaves the report's files in ``out``.

    Raises InputError for unusable settings, LatencyError if a process is lost before anything is
    measured; no process outlives the call.
    """
    if (out / RESULT).exists():
        raise InputError(f"{out} holds a measurement already; choose another folder or remove it")
    track = load_track(settings.track, settings.car.width_m) if settings.track else None
    run, beside, log = Run(settings), Beside(), settings.log
    if log is None:
        log = out / "run.mcap"
        beside = _record(run, out, log, stages)
    with stages.stage("analyse the log"):
        try:
            analysis = analyse(log, settings, track, beside)
        except InputError:
            run.raise_if_broken()
            raise
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "settings.json", settings.model_dump_json(indent=1) + "\n")
        write_files(out, analysis)
    return analysis.result, run


def _record(run: Run, out: Path, log: Path, stages: Stages) -> Beside:
    """Records the run, and the machine beside it."""
    settings, name = run.settings, run.settings.car_name
    ends = settings.attach or (free_endpoint(), free_endpoint())
    lines = {} if settings.attach else _lines(settings, ends, out, stages)
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        with stages.stage("start plant and controller" if lines else "attach"):
            for source, line in lines.items():
                run.children[source] = stack.enter_context(child(line, out / f"{source}.log"))
            stack.enter_context(_explained(run))
            session = stack.enter_context(open_session(Endpoints(connect=ends)))
            director = Director(session, name)
            if lines:
                wait_for_both(director, list(run.children.values()), _START_S)
            else:
                director.wait_for(("plant", "controller"), _ATTACH_S)
            rate_hz, phase = director.status("controller").rate_hz, director.status("plant").phase
            if settings.attach and (phase != "running" or not rate_hz):
                raise InputError(
                    f"car '{name}' is not driving in real time (plant: {phase}); "
                    "start a run with 'bayesrace drive --mode realtime'"
                )
            about = {"latency": {"settings": settings.model_dump_json()}}
            recorder = stack.enter_context(Recorder(session, name, log, about))
            if lines:
                stack.enter_context(_driving(director, settings))
        begin_ns = time.monotonic_ns() + (round(settings.warm_up_s * 1e9) if lines else 0)
        end_ns = begin_ns + round(settings.duration_s * 1e9)
        count = round(settings.duration_s * rate_hz)
        with (
            running_beside(out, settings.load, settings.realtime, rate_hz, begin_ns, count),
            stages.stage(f"record {settings.duration_s:g} s"),
        ):
            run.watch(director, recorder, begin_ns, end_ns)
    run.notes += [f"ended early: {run.ended_early}"] if run.ended_early else []
    return Beside(socket.gethostname(), read_bare_loop(out, rate_hz), run.rss, run.notes)


def _lines(
    settings: LatencySettings, ends: tuple[str, ...], out: Path, stages: Stages
) -> dict[str, list[str]]:
    """The command lines of plant and controller, with the files that they need."""
    files = prepare(
        PreparationSettings(car=settings.car), (settings.track,), stages,
        raceline=settings.raceline, weights=settings.weights, artefact=settings.artefact,
    )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    realtime, car_file = settings.realtime, out / "car.toml"
    write_car(car_file, settings.car)
    both = ["--car", str(car_file), "--name", settings.car_name, "--endpoint", ends[0]]
    both += ["--rate", repr(settings.rate_hz), "--parent-pid", str(os.getpid())]
    both += ["--lock-memory"] if realtime.lock_memory else []
    both += ["--fifo", str(realtime.fifo)] if realtime.fifo else []
    controller = ["controller", *files.arguments, "--listen", ends[1], *both]
    return {"plant": ["plant", *both], "controller": controller}


@contextmanager
def _driving(director: Director, settings: LatencySettings) -> Iterator[None]:
    """A run without end around the track, for the block."""
    limit_s = settings.warm_up_s + settings.duration_s + _AFTERWARDS_S
    track = load_track(settings.track, settings.car.width_m)
    director.start(run_request(track, RunPlan(1, "bayesrace", 0, limit_s, lockstep=False)))
    try:
        yield
    finally:
        with suppress(InputError):  # the plant may be what was lost
            director.stop("measured")


@contextmanager
def _explained(run: Run) -> Iterator[None]:
    """Adds the end of a child to what went wrong because of it."""
    try:
        yield
    except InputError as error:
        if not (ended := run.endings()):
            raise
        raise LatencyError("; ".join([str(error), *ended])) from error
