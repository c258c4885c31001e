"""A cost of one's own: how much slower is a car that may slide less?

The built-in problem tracks the racing line. This one adds the squared sideways speed of the rear
axle, with a weight that can change while the car drives; inputs, limits and track are those of the
built-in problems, and the controller plans, compensates delays and falls back as with these. Both
drive with the same learned weights. With a weight of 0 both must do the same.

    python examples/python/own_cost.py [folder for own_cost.png]
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import bayesrace as br

Floats = NDArray[np.float64]

WEIGHTS: Final = (0.0, 0.001, 0.003, 0.01, 0.03)
"""Of the squared sideways speed [s2/m2]; the squared position error [m2] has a weight of 1."""
LAPS: Final = 3


def gentle(car: br.Car) -> br.Problem:
    """Tracking of the racing line by a car that would rather not slide."""

    def cost(x: ca.SX, stage: dict[str, ca.SX], parameter: dict[str, ca.SX], _last: ca.SX) -> ca.SX:
        px, py, _, _, vy, omega, _ = ca.vertsplit(x)
        error = (px - stage["x"]) ** 2 + (py - stage["y"]) ** 2
        sideways = vy - car.lr_m * omega
        return parameter["q_position"] * error + parameter["q_slide"] * sideways**2

    return br.ocp.driving_problem(
        "gentle",
        br.ocp.e_kinematic(car),
        br.ocp.PREDICTION,
        cost,
        cost_weights=(br.ocp.Parameter("q_slide", "s2/m2", "weight of sliding", low=0),),
    )


@dataclass(frozen=True)
class Result:
    """What a controller drove."""

    run: br.Run
    slip_deg: float
    """Slip angle of the rear axle, RMS over the flying laps."""
    line_m: float
    """Distance from the racing line, RMS over the flying laps."""

    @property
    def flying_s(self) -> float:
        """The fastest lap."""
        return min(self.run.laps)

    def __str__(self) -> str:
        laps = ", ".join(f"{one:.3f}" for one in self.run.laps)
        return (
            f"laps {laps} s; off the track {self.run.off_track}; rear slip {self.slip_deg:.1f}°, "
            f"{1000 * self.line_m:.0f} mm from the line"
        )


def slip_deg(run: br.Run, car: br.Car) -> Floats:
    """Slip angle of the rear axle at each state of the flying laps."""
    x = run.x[run.t > run.laps[0]]
    return np.asarray(np.degrees(np.arctan2(x[:, 4] - car.lr_m * x[:, 5], x[:, 3])))


def driven(controller: br.Controller) -> Result:
    """Laps of the simulated car under this controller."""
    car, track = controller.car, controller.track
    run = br.drive(controller, br.Simulator(car, track), laps=LAPS)
    places = run.x[run.t > run.laps[0], :2]
    distance = np.linalg.norm(places[:, None] - controller.line.xy_m, axis=2).min(axis=1)
    slip = slip_deg(run, car)
    return Result(run, float(np.sqrt(np.mean(slip**2))), float(np.sqrt(np.mean(distance**2))))


def main(folder: Path) -> dict[str, Any]:
    """Drives, prints what came of it, writes the picture; the results."""
    car = br.Car.load("orca")
    track = br.Track.load("harbour", car)
    line = br.racing_line(track, car)
    controller = br.Controller(car, track, line)
    runs: list[br.Run] = []
    for _ in range(2):  # learned from laps without a correction, then from those with one, too
        runs.append(br.drive(controller, br.Simulator(car, track), laps=2))
        controller.weights = br.train(runs)
    built_in = driven(controller)
    print(f"built-in tracking: {built_in}")
    own = br.Controller(car, track, line, problem=gentle(car), parameters={"q_slide": 0.0})
    results = {}
    own.weights = controller.weights
    for q in WEIGHTS:
        own.set_parameters(q_slide=q)
        results[q] = driven(own)
        print(f"own cost, weight {q:5}: {results[q]}")
    same = results[0.0].run.x.tobytes() == built_in.run.x.tobytes()
    print(f"a weight of 0 drives {'the same states to the bit' if same else 'other states'}")
    picture(results, car, track).savefig(folder / "own_cost.png", dpi=150)
    return {"built_in": built_in, "results": results, "same": same}


def picture(results: dict[float, Result], car: br.Car, track: br.Track) -> Figure:
    """Lap time over slip; slip along the track of the last lap, of the least and largest weight."""
    figure = Figure(figsize=(6.4, 7.6), layout="constrained")
    trade, along = figure.subplots(2, 1, height_ratios=(1.2, 1))
    trade.plot(
        [one.slip_deg for one in results.values()],
        [one.flying_s for one in results.values()],
        "o-",
        color="#0072B2",
    )
    for q, one in results.items():
        trade.annotate(f"  weight {q:g}", (one.slip_deg, one.flying_s), va="bottom")
    trade.set(
        xlabel="slip angle of the rear axle, RMS [°]",
        ylabel="fastest lap [s]",
        title="What less sliding costs",
    )
    trade.margins(x=0.22, y=0.1)
    for q, colour in ((min(results), "#D55E00"), (max(results), "#0072B2")):
        run = results[q].run
        last = run.t[run.t > run.laps[0]] >= sum(run.laps[:-1])
        places = run.x[run.t > run.laps[0], :2][last]
        s = track.project_path(places).s_m
        order = np.argsort(s)
        slip = slip_deg(run, car)[last]
        along.plot(s[order], slip[order], color=colour, label=f"weight {q:g}")
    along.set(
        xlabel="along the track, last lap [m]",
        ylabel="slip angle of the rear axle [°]",
        xlim=(0, track.length_m),
    )
    along.legend(fontsize="small")
    for axes in (trade, along):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
