"""Laps with delays on states and actuations, with and without delay compensation.

    python -m benchmarks.delay_compensation [--track NAME|FILE.csv] [--train-track …] [--laps 3]

Plant and controller are processes of their own and run in real time; the plant holds back each
state and each actuation for the delay (``bayesrace plant --delay``), so the input acts twice the
delay later, plus what messages and the step take. Prints a table in Markdown; some four minutes.
"""

import argparse
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from bayesrace.log import LogReader
from bayesrace.messages import TELEMETRY, TRUTH
from bayesrace.recorder import Recorder
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK, Track
from bayesrace.vehicles import DEFAULT_CAR
from operation.analysis.laps import time_laps
from operation.drive import RunPlan
from operation.preparation import Prepared, prepare
from operation.settings import PreparationSettings
from operation.system import started_system
from operation.terminal.progress import stages_on

DELAYS_MS = (0, 10, 20, 40)
CAR = DEFAULT_CAR


@dataclass(frozen=True)
class Outcome:
    """One drive."""

    laps_s: tuple[float, ...]
    off_track: int
    off_track_max_m: float
    samples: int
    fallbacks: int
    delay_ms: float
    """Median of what the controller measured; 0 without compensation."""

    def cells(self) -> list[str]:
        """For the table."""
        first = f"{self.laps_s[0]:.3f}" if self.laps_s else "does not finish"
        flying = f"{min(self.laps_s[1:]):.3f}" if len(self.laps_s) > 1 else "–"
        deepest = f"{1e3 * self.off_track_max_m:.0f}" if self.off_track else "–"
        off = f"{self.off_track} of {self.samples}"
        return [first, flying, off, deepest, str(self.fallbacks), f"{self.delay_ms:.1f}"]


def drive(files: Prepared, delay_ms: float, mode: str, laps: int) -> Outcome:
    """Starts both processes, drives, analyses the log."""
    track = files.first.track
    plan = RunPlan(1, mode, laps, 3.0 * files.first.line.lap_time_s * laps, lockstep=False)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        system = stack.enter_context(started_system(CAR, folder, ["--delay", f"{delay_ms:g}"]))
        stack.enter_context(system.controller([*files.arguments, "--delay", mode]))
        with Recorder(system.session, CAR, folder / "run.mcap"):
            system.drive(track, plan)
        return analyse(folder / "run.mcap", track, laps)


def analyse(log: Path, track: Track, laps: int) -> Outcome:
    """Lap times, and samples off track until the last lap's end."""
    reader = LogReader(log)
    states = reader.select(TRUTH)
    telemetry = reader.select(TELEMETRY)
    xy = np.array([state.x[:2] for state in states])
    time_s = np.array([state.time_s for state in states])
    projection = track.project_path(xy)
    found = time_laps(track, time_s, xy, projection.s_m)
    off_m = projection.off_track_m[: found.after[-1] if len(found.after) >= laps else None]
    return Outcome(
        found.times_s[:laps],
        int((off_m > 0).sum()),
        float(off_m.max()),
        len(off_m),
        sum(message.fallback > 0 for message in telemetry),
        1e3 * float(np.median([message.delay_s for message in telemetry])),
    )


def main() -> None:
    """Prepares once, drives each case, prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--train-track", default=DEFAULT_TRAINING_TRACK)
    parser.add_argument("--laps", type=int, default=3)
    options = parser.parse_args()
    settings = PreparationSettings(train_track=options.train_track)
    with stages_on(Console(stderr=True)) as stages:
        files = prepare(settings, (options.track,), stages)
    print("| delay each way ms | compensated | lap s | flying s | off track | deepest mm "
          "| fallbacks | measured ms |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for delay_ms in DELAYS_MS:
        for mode in ("off", "measured"):
            outcome = drive(files, delay_ms, mode, options.laps)
            word = "yes" if mode == "measured" else "no"
            print("|", " | ".join([str(delay_ms), word, *outcome.cells()]), "|", flush=True)


if __name__ == "__main__":
    main()
