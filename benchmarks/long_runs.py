"""What an hour of driving does to memory, log, counters, clocks and numbers, judged.

    python -m benchmarks.long_runs                           one simulated hour, some minutes
    python -m benchmarks.long_runs --mode realtime           one real hour
    python -m benchmarks.long_runs --mode realtime --duration 180    to try it

Plant and controller are processes of their own, as in a race; this one directs and records twice:
everything, and within ``--max-log`` MB. Every ``--every`` seconds it notes the resident memory of
all three. A line through these samples, those of the first tenth left out, gives the growth per
hour. Leaves the logs in ``--out``. The exit code is 0 if everything holds, else 1.
"""

import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bayesrace.columns import LogColumns
from bayesrace.log_parts import part_files
from bayesrace.messages import STATE, TRUTH
from bayesrace.operation.analysis.laps import laps_in
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.system import started_system
from bayesrace.recorder import Recorder
from bayesrace.studies.evidence.verdict import Check, Verdict
from bayesrace.tracks import DEFAULT_RACE_TRACK, Track
from bayesrace.vehicles import default_car
from benchmarks.harness import Row, arguments, prepared, report, resident_bytes

MB: Final = 1e6
GROWTH_MB: Final = 5.0
"""That plant and controller may grow by in an hour ..."""
RECORDER_MB: Final = 60.0
"""... and, in real time, the process that records without a limit: the index of a log is written at
its end. In lockstep messages wait in its channel, up to 8,192 for each of the two logs."""

DRIVEN: Final = {
    "plant": ("time_s", "laps", "runs", "states_sent", "actuations_received"),
    "controller": (
        "ticks", "states_received", "actuations_sent", "solution", "second_starts", "creeping",
        "cost_jumps", "weights_number", "adoption_us", "adoption_longest_us", "weights_watched",
        "weights_slowed", "weights_accepted",
    ),
}  # fmt: skip
"""Counters that count what went well; all others are of faults."""
TIMING: Final = {
    "plant": ("late", "stale", "overruns", "planned", "braked", "actuations_lost"),
    "controller": (
        "skipped", "deadline_misses", "overruns", "late_states", "states_lost", "states_stale",
        "shifted_plan", "brake", "stop",
    ),
}  # fmt: skip
"""Those that a machine with other work counts up in real time; in lockstep they are 0."""
TIMED_SHARE: Final = 1e-3
"""Of the cycles, in real time."""
STOPPED: Final = "clipped"
"""The plant's: in lockstep 0. In real time an input acts a little later than the state it is for:
one that leads to the steering's stop leads beyond it."""


@contextmanager
def sampled_memory(pids: Mapping[str, int | str], every_s: float) -> Iterator[list[Row]]:
    """Resident memory of each process over the block, with the time since its beginning."""
    samples: list[Row] = []
    done, begin_s = threading.Event(), time.monotonic()

    def sample() -> None:
        while not done.wait(every_s):
            now = {name: resident_bytes(pid) for name, pid in pids.items()}
            samples.append({"time_s": time.monotonic() - begin_s, **now})

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        done.set()
        thread.join()


def drive(given: Any, folder: Path) -> Row:
    """Drives and records; memory, counters of all, and sizes of the logs."""
    lockstep, car = given.mode == "lockstep", default_car()
    made = prepared(given.track)
    with ExitStack() as stack:
        system = stack.enter_context(started_system(car.name, folder, lockstep=lockstep))
        stack.enter_context(system.controller(made.arguments))
        limits = {"run": None, "limited": round(given.max_log * MB)}
        records = (
            Recorder(system.recording, car.name, folder / f"{name}.mcap", {}, most)
            for name, most in limits.items()
        )
        recorders = [stack.enter_context(one) for one in records]
        pids: dict[str, int | str] = {one: process.pid for one, process in system.children.items()}
        begin_s = time.monotonic()
        with sampled_memory(pids | {"recorder": "self"}, given.every) as memory:
            plan = RunPlan(1, "bayesrace", 0, given.duration, lockstep)
            end = system.drive(made.first.track, plan, recorders[0])
        took_s = time.monotonic() - begin_s
        controller = system.director.status("controller").counters
    parts = part_files(folder / "limited.mcap").values()
    return {
        "track": made.first.track, "end": end, "took_s": took_s, "memory": memory,
        "plant": dict(end.data), "controller": dict(controller),
        "recorder": asdict(recorders[0].counters), "limited": asdict(recorders[1].counters),
        "log_mb": (folder / "run.mcap").stat().st_size / MB,
        "limited_mb": sum(one.stat().st_size for one in parts) / MB,
    }  # fmt: skip


def growth_mb_per_hour(samples: list[Row], name: str, hours: float) -> float:
    """Of a process, by a line through its samples without the first tenth; ``hours`` were driven
    in all."""
    rows = samples[len(samples) // 10 :]
    if len(rows) < 3:
        return float("nan")
    time_h = np.array([one["time_s"] for one in rows]) / samples[-1]["time_s"] * hours
    return float(np.polyfit(time_h, [one[name] / MB for one in rows], 1)[0])


def log_figures(log: Path, track: Track) -> Row:
    """Laps, clocks and numbers of the recorded run."""
    laps = laps_in(log, 1, track).laps
    columns = LogColumns(log, {STATE: "seq time_s source_time_ns x", TRUTH: "x"}).read()
    states = columns[STATE]
    flying = np.array(laps.times_s[1:])
    trend = np.polyfit(np.arange(len(flying)), flying, 1)[0] if len(flying) > 2 else float("nan")
    passed_s = 1e-9 * (states["source_time_ns"] - states["source_time_ns"][0])
    behind_s = passed_s - (states["time_s"] - states["time_s"][0])
    psi = np.abs(columns[TRUTH]["x"][:, 2])
    step_s = float(np.median(np.diff(states["time_s"])))
    periods = (states["time_s"] - states["time_s"][0]) / step_s
    return {
        "laps": laps.count, "fastest_s": float(flying.min(initial=np.inf)),
        "slowest_s": float(flying.max(initial=0.0)), "trend_ms_per_100_laps": 1e5 * float(trend),
        "states": len(states), "clock_drift_ppm": 1e6 * float(np.polyfit(passed_s, behind_s, 1)[0]),
        "clock_behind_ms": 1e3 * float(np.ptp(behind_s)),
        "off_the_periods_s": step_s * float(np.abs(periods - np.round(periods)).max()),
        "largest_heading_rad": float(psi.max()),
        "heading_spacing_rad": float(np.spacing(psi.max())),
    }  # fmt: skip


def checks(result: Row, log: Row, given: Any, hours: float) -> Iterator[Check]:
    """What must hold after a long run."""
    lockstep = given.mode == "lockstep"

    def at_most(subject: str, what: str, found: float, most: float, unit: str = "") -> Check:
        text = f"{found:.3g}{unit}"
        return Check(subject, f"{what}: at most {most:g}{unit}", bool(abs(found) <= most), text)

    judged = {"plant": GROWTH_MB, "controller": GROWTH_MB}
    for name, most in (judged if lockstep else judged | {"recorder": RECORDER_MB}).items():
        grown = growth_mb_per_hour(result["memory"], name, hours)
        yield at_most("memory", f"{name} grows in an hour", grown, most, " MB")
    yield at_most("log", "all of the limited one", result["limited_mb"], given.max_log, " MB")
    for name in ("recorder", "limited"):
        for counter in ("missing", "unnumbered", "unrecorded"):
            yield at_most("log", f"{name}: {counter}", result[name][counter], 0)
    for source in ("plant", "controller"):
        for counter, count in result[source].items():
            if counter in DRIVEN[source] or not isinstance(count, int | float):
                continue
            if not lockstep and counter == STOPPED:
                continue
            timed = not lockstep and counter in TIMING[source]
            most = TIMED_SHARE * log["states"] if timed else 0
            yield at_most(source, counter, count, most)
    yield at_most("laps", "trend in 100 laps", log["trend_ms_per_100_laps"], 10, " ms")
    spread_ms = 1e3 * (log["slowest_s"] - log["fastest_s"])
    yield at_most("laps", "slowest minus fastest flying lap", spread_ms, 100, " ms")
    yield at_most("numbers", "times off whole periods", log["off_the_periods_s"], 1e-6, " s")
    yield at_most("numbers", "spacing of headings", log["heading_spacing_rad"], 1e-9, " rad")
    if not lockstep:
        yield at_most("clock", "plant time against the clock", log["clock_drift_ppm"], 100, " ppm")


def main() -> int:
    """Drives, judges and prints; returns the exit code."""
    given = arguments(
        __doc__, mode="lockstep", duration=3600.0, track=DEFAULT_RACE_TRACK, every=2.0,
        max_log=50.0, out=Path("runs") / f"long-{datetime.now(UTC).astimezone():%Y%m%d-%H%M%S}",
    )  # fmt: skip
    given.out.mkdir(parents=True)
    result = drive(given, given.out)
    hours = given.duration / 3600
    log = log_figures(given.out / "run.mcap", result["track"])
    kept = log_figures(given.out / "limited.mcap", result["track"])
    log |= {
        "log_mb_per_hour": result["log_mb"] / hours, "limited_mb": result["limited_mb"],
        "parts_deleted": result["limited"]["parts_deleted"], "limited_states": kept["states"],
        "took_s": result["took_s"], "messages": result["recorder"]["written"],
    }  # fmt: skip
    memory = result["memory"]
    for name in ("plant", "controller", "recorder"):
        mb = [one[name] / MB for one in memory]
        log |= {
            f"{name}_begin_mb": mb[0], f"{name}_end_mb": mb[-1], f"{name}_most_mb": max(mb),
            f"{name}_mb_per_hour": growth_mb_per_hour(memory, name, hours),
        }  # fmt: skip
    rows = [{"what": name, "number": value} for name, value in log.items()]
    report(given, f"{given.mode}, {given.duration:g} s: {given.out}", rows)
    verdict = Verdict("long_runs", tuple(checks(result, log, given, hours)))
    verdict.print(Console(markup=False))
    return verdict.exit_code


if __name__ == "__main__":
    sys.exit(main())
