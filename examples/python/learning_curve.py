"""A car and a track of one's own, and how fast the car learns on it.

The car is a file that this script writes, the track an array of points. The controller knows the
car's geometry and motor, but not its tyres. It drives two laps, learns from all laps so far, drives
again, and so on, from another place on the start line for each seed. The controller with the true
model (BestCase) drives the laps that it can come up to.

    python examples/python/learning_curve.py [folder for learning_curve.png]
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from threadpoolctl import threadpool_limits

import bayesrace as br

SEEDS: Final = 3
ROUNDS: Final = 5
LAPS: Final = 2
"""Of a round: one from a standing start, one flying."""
POINTS: Final = 400
"""Training points that are kept of the samples, at most."""
CAR: Final = """
name = "twentyfourth"   # 1:24; numbers of the right size, but of no car that exists

[geometry]
lf_m = 0.055
lr_m = 0.055
mass_kg = 0.16
inertia_kgm2 = 3.2e-4
width_m = 0.08
length_m = 0.17

[tyres]                 # for the simulator and BestCase; the learning controller does without
model = "pacejka"
front = { b = 3.0, c = 1.2, d = 0.72 }
rear = { b = 3.6, c = 1.25, d = 0.72 }

[drive]
model = "dc_motor"
cm1 = 1.1
cm2 = 0.17
cr0 = 0.12
cr2 = 0.0015

[limits]
d_min = -0.2
d_max = 1.0
delta_max_rad = 0.4
delta_rate_max_radps = 5.0
friction = 0.6
"""


def own_track(car: br.Car) -> br.Track:
    """A clover of three leaves, 0.66 m wide: rows x, y, width to the right, width to the left."""
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    radius = 2.2 * (1 + 0.28 * np.cos(3 * angle) + 0.12 * np.sin(2 * angle))
    half = np.full_like(angle, 0.33)
    points = [1.3 * radius * np.cos(angle), radius * np.sin(angle), half, half]
    return br.Track.load(np.column_stack(points), car, name="clover")


@dataclass
class Curve:
    """One seed's rounds."""

    runs: list[br.Run] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    """RMS of what the model errs by on BestCase's laps, over that without correction."""

    @property
    def flying_s(self) -> list[float]:
        """Flying lap of each round; NaN where it was not finished."""
        return [one.laps[-1] if len(one.laps) == LAPS else np.nan for one in self.runs]

    @property
    def off_track(self) -> list[int]:
        """States of each round that are off the track."""
        return [one.off_track for one in self.runs]


def error_left(weights: br.Weights | None, reference: br.Run) -> float:
    """How large the errors of the corrected model are, as a share of those without correction."""
    if weights is None:
        return 1.0
    z, errors = br.residuals(reference)
    with threadpool_limits(1, "blas"):  # on a busy machine, threads would wait for each other
        found = np.column_stack([one.predict(z) for one in weights.to_sklearn()])
    scale = errors.std(axis=0)  # vx, vy and omega alike
    left, all_of_it = (errors - found) / scale, errors / scale
    return float(np.sqrt(np.mean(left**2) / np.mean(all_of_it**2)))


def learn(controller: br.Controller, reference: br.Run, seed: int) -> Curve:
    """The rounds of one seed."""
    car, track, curve = controller.car, controller.track, Curve()
    x, y, psi = track.start_pose()
    aside = np.random.default_rng(seed).uniform(-0.1, 0.1)
    start = br.State(x - aside * np.sin(psi), y + aside * np.cos(psi), psi, 0.1, 0, 0, 0)
    controller.weights = None
    for k in range(ROUNDS):
        curve.error.append(error_left(controller.weights, reference))
        run = br.drive(controller, br.Simulator(car, track), laps=LAPS, x0=start)
        curve.runs.append(run)
        if k == ROUNDS - 1:
            break
        try:
            controller.weights = br.train(curve.runs, points=POINTS, seed=seed)
        except br.InputError as refused:  # worse than those in use on what was driven last
            print(refused)
    return curve


def main(folder: Path) -> dict[str, Any]:
    """Learns, prints what came of it, writes the picture; BestCase's run and the curves."""
    file = folder / "twentyfourth.toml"
    file.write_text(CAR)
    car = br.Car.load(file)
    track = own_track(car)
    line = br.racing_line(track, car)
    best_case = br.Controller(car, track, line, model="dynamic")
    best = br.drive(best_case, br.Simulator(car, track), laps=LAPS)
    print(f"BestCase: {best.laps[-1]:.3f} s; the racing line: {line.lap_time_s:.3f} s")
    controller = br.Controller(car, track, line)
    curves = [learn(controller, best, seed) for seed in range(SEEDS)]
    for k in range(ROUNDS):
        laps = ", ".join(f"{one.flying_s[k]:.3f}" for one in curves)
        off = ", ".join(str(one.off_track[k]) for one in curves)
        errors = ", ".join(f"{one.error[k]:.0%}" for one in curves)
        print(f"learned from {LAPS * k:2} laps: {laps} s; off the track: {off}; errors: {errors}")
    picture(curves, best, track).savefig(folder / "learning_curve.png", dpi=150)
    return {"curves": curves, "best": best}


def picture(curves: list[Curve], best: br.Run, track: br.Track) -> Figure:
    """First and last round on the track; lap times and errors over the laps learned from."""
    figure = Figure(figsize=(6.4, 8.4), layout="constrained")
    place, lap, error = figure.subplots(3, 1, height_ratios=(1.7, 1, 1))
    for edge in track.boundaries(0.03):
        closed = np.vstack([edge, edge[:1]])
        place.plot(closed[:, 0], closed[:, 1], color="#1c1c1a", linewidth=1.2)
    runs = curves[0].runs
    for run, colour, label in (
        (runs[0], "#D55E00", "first round"),
        (runs[-1], "#0072B2", f"round {ROUNDS}"),
        (best, "#3d3d3a", "BestCase"),
    ):
        style = ":" if run is best else "-"
        place.plot(run.x[:, 0], run.x[:, 1], style, color=colour, linewidth=1.4, label=label)
    place.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    place.legend(fontsize="small", loc=(0.34, 0.45), frameon=False)
    learned = LAPS * np.arange(ROUNDS)
    for seed, curve in enumerate(curves):
        shade = {"color": ("#0072B2", "#56B4E9", "#009E73")[seed % 3], "label": f"seed {seed}"}
        lap.plot(learned, curve.flying_s, "o-", **shade)
        error.plot(learned, 100 * np.array(curve.error), "o-", **shade)
    lap.axhline(best.laps[-1], color="#3d3d3a", linestyle=":", label="BestCase")
    lap.set(ylabel="flying lap [s]", ylim=(0.9 * best.laps[-1], None))
    lap.legend(fontsize="small")
    error.set(ylabel="model's error left [%]", xlabel="laps learned from", ylim=(0, 105))
    for axes in (lap, error):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
