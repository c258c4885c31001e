"""What checks and watch make of good and of spoilt weights, from a standing start.

    python -m benchmarks.spoilt_weights [--car NAME] [--seconds 12]

Weights learned from the car's training drive are spoilt in nine ways
(tests/takeover/spoilt_weights.py) and sent before the car has driven, on its training track and on
its race track, where those that were learned are proven. These are sent, too, where none are
proven. Prints what became of the weights, at which cycle and speed, and how far the car passed the
track's edge, with checks and watch and without them.
"""

import math

from bayesrace.gp.weights import read_weights
from bayesrace.vehicles import DEFAULT_CAR, get_car
from benchmarks.harness import Row, arguments, prepared, report
from tests.takeover.spoilt_weights import SPOILT, spoilt
from tests.takeover.watched import Course


def main() -> None:
    """Drives each kind of weights on each track."""
    given = arguments(__doc__, car=DEFAULT_CAR, seconds=12.0)
    car, rows = get_car(given.car), list[Row]()
    weights = read_weights(prepared(car=car).weights)
    for track in dict.fromkeys((car.train_track, car.race_track)):
        course = Course(car, track, given.seconds)
        for kind in ("as learned", *SPOILT):
            good = kind not in SPOILT
            sent, proven = (weights, None) if good else (spoilt(weights, kind), weights)
            became, watched_m = course.drive(sent, proven)
            row = {"track": track, "weights": kind, "became": became}
            beyond_m = {"beyond the edge [m]": watched_m} if math.isfinite(watched_m) else {}
            rows.append(row | beyond_m | {"unwatched [m]": course.drive_unwatched(sent)})
    report(given, car.name, rows)


if __name__ == "__main__":
    main()
