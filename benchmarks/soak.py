"""The promises of free-running mode, each measured by ``bayesrace latency`` and judged.

    python -m benchmarks.soak            about a quarter of an hour
    python -m benchmarks.soak --share 0.1   a tenth of each run's length, to try it

1. 50 Hz for ten minutes: state to actuation at most 0.35 ms (median) and 1 ms (99th percentile)
   more than messages alone in the same run; misses at most those of the bare loop in the same run
   + 2; resident memory grows by less than 1 MB after the first minute; every message sent was
   received or counted as lost.
2. 500 Hz for one minute: the same for state to actuation; mean period within 0.1 % (of the bare
   loop's, where that skipped too).
3. 50 Hz for one minute with all cores busy: a lap, and no sample off the track.

Nothing else should be running. A stall of the machine longer than a period is seen by the bare
loop too; a shorter one moves the maximum of a leg and no verdict. Leaves the folders of the runs,
each with its picture, under runs/soak-DATE-TIME. The exit code is the number of broken promises.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

Result = dict[str, Any]


class Promise(NamedTuple):
    """Something to hold in a run."""

    text: str
    holds: Callable[[Result], bool]
    measured: Callable[[Result], str]


class Case(NamedTuple):
    """One run and what is to hold in it."""

    name: str
    duration_s: float
    options: tuple[str, ...]
    promises: tuple[Promise, ...]


def complete(result: Result) -> bool:
    """Every message is accounted for, in each direction and altogether."""
    altogether = result["sent"] == result["received"] + result["lost"]
    return altogether and all(one["complete"] for one in result["traffic"].values())


def bare(result: Result) -> float:
    """By how much the bare loop's mean period was too long."""
    return float(result["bare_loop_us"]["mean_period_us"] * result["rate_hz"] * 1e-6 - 1.0)


def keeps_rate(result: Result) -> bool:
    """Mean period within 0.1 %; where the machine's stalls made the bare loop skip, of its own."""
    error = result["rate_error"]
    return bool(abs(error) <= 1e-3 or abs(error - bare(result)) <= 1e-3)


def beyond_messages(percentile: str, most_us: float) -> Promise:
    """State to actuation less the bare round trip."""

    def more_us(result: Result) -> float:
        answer, messages = result["state_to_actuation_us"], result["round_trip_us"]
        return float(answer[percentile] - messages[percentile])

    return Promise(
        f"state to actuation {percentile} <= bare round trip's + {most_us:.0f} us",
        lambda result: more_us(result) <= most_us,
        lambda result: f"{more_us(result):+.0f} us",
    )


ANSWERS = (beyond_messages("p50", 350.0), beyond_messages("p99", 1000.0))

CASES = (
    Case(
        "50hz", 600.0, ("--rate", "50"),
        (
            *ANSWERS,
            Promise("deadline misses <= bare loop's + 2",
                    lambda r: r["bare_loop_misses"] is not None
                    and r["deadline_misses"] <= r["bare_loop_misses"] + 2,
                    lambda r: f"{r['deadline_misses']}, bare loop {r['bare_loop_misses']}"),
            Promise("resident memory grows < 1 MB",
                    lambda r: r["rss_growth_bytes"] < 1_000_000,
                    lambda r: f"{r['rss_growth_bytes'] / 1000:.0f} kB"),
            Promise("sent = received + lost", complete,
                    lambda r: f"{r['sent']} = {r['received']} + {r['lost']}"),
        ),
    ),
    Case(
        "500hz", 60.0, ("--rate", "500"),
        (
            *ANSWERS,
            Promise("mean period within 0.1 %, of the bare loop's if the machine did not give more",
                    keeps_rate, lambda r: f"{r['rate_error']:+.3%}, bare loop {bare(r):+.3%}"),
        ),
    ),
    Case(
        "load", 60.0, ("--rate", "50", "--load", str(os.cpu_count() or 1)),
        (
            Promise("a lap under load", lambda r: r["laps"] >= 1, lambda r: f"{r['laps']}"),
            Promise("no sample off track under load",
                    lambda r: r["off_track_samples"] == 0,
                    lambda r: f"{r['off_track_samples']} of {r['states']}"),
        ),
    ),
)  # fmt: skip


def measure(case: Case, share: float, folder: Path, further: list[str]) -> Result:
    """Runs the case; what the command says goes to the terminal."""
    line = [sys.executable, "-m", "operation.cli", "latency", *case.options, *further]
    duration_s = max(case.duration_s * share, 5.0)
    line += ["--duration", f"{duration_s:g}", "--out", str(folder / case.name)]
    subprocess.run(line, check=True)
    content: Result = json.loads((folder / case.name / "latency.json").read_text())
    return content


def main() -> None:
    """Measures all cases, or those named; prints a verdict per promise."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    names = [case.name for case in CASES]
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(names)} [all]")
    parser.add_argument("--share", type=float, default=1.0, help="of the runs' length")
    parser.add_argument("--realtime", action="store_true", help="with --fifo 50 --lock-memory")
    given = parser.parse_args()
    if unknown := set(given.cases) - set(names):
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    further = ["--fifo", "50", "--lock-memory"] if given.realtime else []
    time = datetime.now(UTC).astimezone().strftime("%Y%m%d-%H%M%S")
    folder = Path("runs") / f"soak-{time}"
    verdicts = []
    for case in CASES:
        if given.cases and case.name not in given.cases:
            continue
        print(f"\n{case.name}", flush=True)
        result = measure(case, given.share, folder, further)
        verdicts += [(case.name, p, p.holds(result), p.measured(result)) for p in case.promises]
    print()
    for name, promise, holds, measured in verdicts:
        print(f"{'holds ' if holds else 'BROKEN'}  {name:<6} {promise.text}: {measured}")
    sys.exit(sum(not holds for _, _, holds, _ in verdicts))


if __name__ == "__main__":
    main()
