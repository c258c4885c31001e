"""What adoptions of weights cost a free-running control loop, beside the bare loop in one run.

    python -m benchmarks.takeover [--rate HZ] [--seconds S] [--rounds N]

Stretches without and with an adoption every quarter of a second follow each other, so that what the
machine does meanwhile hits both. Columns: cycles, adoptions, deadline misses, overruns, releases
skipped; then the time that an adoption took in the control thread. Nothing else should run.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesrace.gp.weights import encode_weights, read_weights
from bayesrace.transport import free_endpoint
from bayesrace.vehicles import DEFAULT_CAR
from tests.network.cars import gentle_course, start_controller, start_plant
from tests.network.observer import Observer, observing
from tests.programs import until

COUNTED = ("ticks", "weights_accepted", "deadline_misses", "overruns", "skipped")
PAUSE_S = 0.25


def main() -> None:
    """The measurement."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--seconds", type=float, default=3.0, help="of a stretch")
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    plant_at, controller_at = free_endpoint(), free_endpoint()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        course = gentle_course(folder)
        weights = read_weights(course.weights_file)
        rate = ("--rate", str(chosen.rate))
        with (
            start_plant(folder, plant_at),
            start_controller(folder, course, plant_at, controller_at, *rate) as controller,
            observing(
                [plant_at, controller_at], DEFAULT_CAR, course.track, folder / "log"
            ) as observer,
        ):
            observer.start(1)
            until(lambda: observer.status("controller")["counters"]["validator"], "validator")
            time.sleep(3.0)
            sums = {"bare": np.zeros(5, int), "adoptions": np.zeros(5, int)}
            adoption_us = []
            for number in range(2 * chosen.rounds):
                kind = ("bare", "adoptions")[number % 2]
                before, end = counted(observer), time.monotonic() + chosen.seconds
                while time.monotonic() < end:
                    if kind == "adoptions":
                        version = f"v{time.monotonic_ns()}"
                        data = encode_weights(replace(weights, version=version))
                        adoption_us.append(observer.director.send_weights(data).data["adoption_us"])
                    time.sleep(PAUSE_S)
                sums[kind] += counted(observer) - before
            observer.stop()
            controller.end()
    print(f"{'':10}", *(f"{name:>16}" for name in COUNTED))
    for kind, row in sums.items():
        print(f"{kind:10}", *(f"{count:16d}" for count in row))
    shares = np.percentile(np.array(adoption_us, float), [0, 50, 90, 100])
    print("adoption, us: least {:.1f}, p50 {:.1f}, p90 {:.1f}, most {:.1f}".format(*shares))


def counted(observer: Observer) -> "np.ndarray[tuple[int], np.dtype[np.int_]]":
    """The controller's counters."""
    counters = observer.status("controller")["counters"]
    return np.array([counters[name] for name in COUNTED])


if __name__ == "__main__":
    main()
