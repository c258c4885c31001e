"""How much grip the racing line should assume: BestCase laps along lines for several frictions.

    python -m benchmarks.racing_line_friction [--track T]

The controller knows the car perfectly, so what differs is the line's path and speed profile alone.
docs/decisions/2026-11-21-racing-line-limits.md holds the conclusion.
"""

import argparse

from bayesrace.raceline import RaceLineSettings, compute_raceline
from bayesrace.tracks import DEFAULT_RACE_TRACK, load_track
from bayesrace.vehicles import DEFAULT_CAR, get_car
from codegen.build import build
from codegen.settings import BuildSettings
from operation.closed_loop import drive_compiled

FRICTIONS = (0.65, 0.70, 0.75, 0.80, 0.85)


def main() -> None:
    """Prints a line per friction number."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    track, car = load_track(parser.parse_args().track), get_car(DEFAULT_CAR)
    artefact, _ = build(BuildSettings.best_case(car.name))
    print(f"{track.name}: friction, the line's own flying lap, driven laps")
    for friction in FRICTIONS:
        line = compute_raceline(track, car, RaceLineSettings(friction=friction))
        driven = drive_compiled(artefact, track, line, car=car)
        print(f"{friction:.2f}  {line.lap_time_s:.3f} s  {driven}", flush=True)


if __name__ == "__main__":
    main()
