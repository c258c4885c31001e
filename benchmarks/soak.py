"""The promises of free-running mode, each measured by ``bayesrace latency`` and judged.

    python -m benchmarks.soak                about a quarter of an hour
    python -m benchmarks.soak --share 0.1    a tenth of each run's length, to try it

Three runs: 50 Hz for ten minutes, 500 Hz for one minute, and 50 Hz for one minute with all cores
busy. State to actuation is judged by messages alone in the same run, misses and mean period by a
loop in the same run that only sleeps. Nothing else should be running: a stall of the machine longer
than a period hits that loop, too; a shorter one moves the maximum of a leg and no verdict. Leaves
the folders of the runs, each with its picture. The exit code is the number of broken promises.
"""

import json
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.harness import Row, arguments, report

_BUSY = str(os.cpu_count() or 1)
_ANSWERS = {"beyond messages, p50 [us]": 350.0, "beyond messages, p99 [us]": 1000.0}
PROMISES: dict[str, tuple[float, tuple[str, ...], dict[str, float]]] = {
    "50hz": (600.0, ("--rate", "50"), _ANSWERS | {
        "deadline misses beyond the bare loop's": 2, "growth of memory [MB]": 1.0,
        "messages unaccounted for": 0,
    }),
    "500hz": (60.0, ("--rate", "500"), _ANSWERS | {"error of the mean period": 1e-3}),
    "load": (60.0, ("--rate", "50", "--load", _BUSY), {
        "laps missing of one": 0, "samples off track": 0,
    }),
}  # fmt: skip
"""Of each run: length [s], options, and the most that is allowed of its figures."""


def figures(result: Row) -> Row:
    """What a run shows, by name: the less the better."""
    answer, messages = result["state_to_actuation_us"], result["round_trip_us"]
    bare, error = result["bare_loop_us"]["mean_period_us"], result["rate_error"]
    beyond = error - (bare * result["rate_hz"] * 1e-6 - 1.0)  # where stalls skipped periods
    incomplete = sum(not one["complete"] for one in result["traffic"].values())
    missing = result["sent"] - result["received"]
    misses = result["deadline_misses"] - result["bare_loop_misses"]
    return {
        "beyond messages, p50 [us]": answer["p50"] - messages["p50"],
        "beyond messages, p99 [us]": answer["p99"] - messages["p99"],
        "deadline misses beyond the bare loop's": misses,
        "growth of memory [MB]": result["rss_growth_bytes"] * 1e-6,
        "messages unaccounted for": abs(missing - result["lost"]) + incomplete,
        "error of the mean period": min(abs(error), abs(beyond)),
        "laps missing of one": 1 - result["laps"],
        "samples off track": result["off_track_samples"],
    }


def main() -> None:
    """Measures all runs, or those named; prints a verdict for each promise."""
    given, rows = arguments(__doc__, runs=tuple(PROMISES), share=1.0), []
    folder = Path("runs") / datetime.now(UTC).astimezone().strftime("soak-%Y%m%d-%H%M%S")
    for run in given.runs:
        duration_s, options, promises = PROMISES[run]
        line = [sys.executable, "-m", "bayesrace.operation.cli", "latency", *options]
        line += ["--duration", f"{max(duration_s * given.share, 5.0):g}", "--out"]
        subprocess.run([*line, str(folder / run)], check=True)
        found = figures(json.loads((folder / run / "latency.json").read_text()))
        for name, most in promises.items():
            verdict = "holds" if found[name] <= most else "BROKEN"
            numbers = {"measured": float(found[name]), "at most": most}
            rows.append({"run": run, "": verdict, "promise": name, **numbers})
    report(given, f"{folder}", rows)
    sys.exit(sum(row[""] == "BROKEN" for row in rows))


if __name__ == "__main__":
    main()
