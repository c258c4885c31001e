"""What own and attached measurements have in common: whom to measure, and the order of doing it."""

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.tracks import Track
from bayesrace.transport import Director
from experiments.latency.bare_loop import BareRun, arguments, read_bare_run
from experiments.latency.measure import Measurement
from experiments.latency.observer import lower_priority
from experiments.latency.outcome import outcome
from experiments.latency.report import RESULT, write_files
from experiments.latency.results import LatencyResult
from experiments.latency.settings import LatencySettings
from experiments.processes import Child, child, endings
from experiments.progress import Stages

__all__ = [
    "LatencyError",
    "Measured",
    "Stand",
    "check_new",
    "explained",
    "measure",
    "measurement",
    "open_folder",
]


class LatencyError(RuntimeError):
    """The measurement broke off."""


@dataclass(frozen=True)
class Measured:
    """What came of it; the files are written."""

    result: LatencyResult
    broken: str
    """Why the time observed was cut short, though it should not have been."""
    interrupted: bool
    """By SIGINT or SIGTERM."""

    def raise_if_broken(self) -> None:
        """KeyboardInterrupt or LatencyError, if it was cut short."""
        if self.interrupted:
            raise KeyboardInterrupt
        if self.broken:
            raise LatencyError(self.broken)


@dataclass(frozen=True)
class Stand:
    """Who is measured, and what to say if a process ends."""

    session: Any
    director: Director
    children: list[Child]
    pids: dict[str, int]


def check_new(out: Path) -> None:
    """InputError if there is a measurement in that folder."""
    if (out / RESULT).exists():
        raise InputError(f"{out} holds a measurement already; choose another folder or remove it")


def open_folder(out: Path, settings: LatencySettings) -> None:
    """Makes the folder, with the settings as resolved."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "settings.json", settings.model_dump_json(indent=1) + "\n")


def measurement(
    settings: LatencySettings, stand: Stand, rate_hz: float, track: Track | None, out: Path
) -> Measurement:
    """Ready to listen: make it before the run starts, to follow that from its beginning."""
    return Measurement(
        stand.session, stand.director, settings.car_name, rate_hz, settings.duration_s, track, out,
        stand.pids,
    )  # fmt: skip


def measure(
    settings: LatencySettings, stand: Stand, measured: Measurement, out: Path, stages: Stages
) -> Measured:
    """Load, bare loop, the time observed, and the files."""
    begin_ns = time.monotonic_ns() + round(settings.settle_s * 1e9)
    end_ns = begin_ns + round(settings.duration_s * 1e9)
    started = datetime.now(UTC).astimezone()
    with ExitStack() as stack:
        for _ in range(settings.load):
            parent = ["--parent-pid", str(os.getpid())]
            stack.enter_context(child(parent, out / "load.log", "experiments.latency.load"))
        line = arguments(measured.rate_hz, begin_ns, end_ns, settings.realtime, os.getpid())
        module = "experiments.latency.bare_loop"
        bare = stack.enter_context(child(line, out / "bare_loop.log", module))
        lower_priority()
        with explained(stand.children), stages.stage(f"observe for {settings.duration_s:g} s"):
            measured.settle(begin_ns)
            measured.observe()
        bare_run = _bare_run(bare)
    result = outcome(settings, measured, bare_run, started)
    histograms = {name: one.total for name, one in measured.observer.histograms.items()}
    medians = {name: one.medians for name, one in measured.observer.histograms.items()}
    write_files(out, result, histograms, medians, bare_run)
    broken = "" if settings.attach else measured.ended_early
    if broken:
        time.sleep(0.2)  # the system tells of a death a moment after the network does
        broken = "; ".join([broken, *endings(stand.children)])
    return Measured(result, broken, measured.interrupted)


def _bare_run(bare: Child) -> BareRun | None:
    if not bare.wait(1.0):
        bare.stop()
    with suppress(InputError):
        return read_bare_run(bare.output)
    return None


@contextmanager
def explained(children: list[Child]) -> Iterator[None]:
    """Turns the end of a child into the reason of what went wrong because of it."""
    try:
        yield
    except InputError as error:
        time.sleep(0.2)
        raise LatencyError("; ".join([str(error), *endings(children)])) from error
