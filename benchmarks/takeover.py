"""What the adoption of new weights costs the control thread of a free-running controller.

    python -m benchmarks.takeover [--adoptions 50] [--rate 50]

A car is driven in real time while its controller gets new weights four times a second. Nothing else
should run.
"""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bayesrace.gp.weights import encode_weights, read_weights
from bayesrace.operation.drive import RunPlan, run_request
from bayesrace.operation.system import started_system
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import DEFAULT_CAR
from benchmarks.harness import arguments, percentiles, prepared, report

_PAUSE_S = 0.25


def main() -> None:
    """Drives, sends weights, prints percentiles."""
    given, taken_us = arguments(__doc__, adoptions=50, rate=50.0), []
    made, both = prepared(DEFAULT_RACE_TRACK), ["--rate", f"{given.rate:g}"]
    weights = read_weights(made.weights)
    with (
        TemporaryDirectory() as folder,
        started_system(DEFAULT_CAR, Path(folder), both=both) as system,
        system.controller(made.arguments),
    ):
        director, plan = system.director, RunPlan(1, "", 0, 1e5, lockstep=False)
        director.start(run_request(made.first.track, plan))
        for number in range(given.adoptions):
            time.sleep(_PAUSE_S)
            sent = encode_weights(replace(weights, version=f"{weights.version}-{number}"))
            taken_us.append(director.send_weights(sent).data["adoption_us"])
        director.stop("measured")
    row = {"us": "adoption", **percentiles(taken_us, 50, 90, 100)}
    report(given, f"{given.adoptions} adoptions at {given.rate:g} Hz", [row])


if __name__ == "__main__":
    main()
