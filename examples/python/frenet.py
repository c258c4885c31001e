"""A model and a reference of one's own: MPC of a car in the coordinates of a track.

The kinematic single-track model in Frenet's coordinates: arc length s of the track's middle,
distance n from it to the left, heading mu relative to it, speed v and steering angle delta. The
curvature is part of the model, as a Fourier series. Stages have the track's widths and the wanted
speed as parameters: read from the track where the last plan was. There is no racing line: speed in
bends follows from a limit of the lateral acceleration. The loop is written by hand.

    python examples/python/frenet.py [folder for frenet.png]
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import casadi as ca
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

import bayesrace as br

Floats = NDArray[np.float64]

STEP_S: Final = 0.05
HORIZON: Final = 24
LAPS: Final = 3
SPEED_MPS: Final = 6.0
MARGIN_M: Final = 0.18
"""Room for the model's errors between the car's outline and the edges: its tyres do not slip."""
HARMONICS: Final = 40
"""Of the curvature: the shortest is 0.7 m long on this track."""
PARAMETERS: Final = {
    "q_middle": 0.05, "q_heading": 0.1, "q_speed": 0.1, "r_acceleration": 0.01,
    "r_steering": 0.02, "w_track": 300.0, "w_lateral": 2.0, "lateral_max": 3.5,
    "acceleration_max": 4.0, "delta_max": 0.4189, "rate_max": 3.2,
}  # fmt: skip
SOLVER: Final = {"early_stop_tol": 1e-4}
"""A step stops iterating there; the plan changes by less than the model errs by."""


def curvature_of(track: br.Track, s: Any) -> Any:
    """Curvature at an arc length as an expression: smooth, and periodic as the track is."""
    count = 8 * HARMONICS
    sampled = track.curvature(np.arange(count) * track.length_m / count)
    factors = np.fft.rfft(sampled)[: HARMONICS + 1] / count
    phase = 2 * np.pi / track.length_m * s
    waves = (
        one.real * ca.cos(k * phase) - one.imag * ca.sin(k * phase)
        for k, one in enumerate(factors.tolist())
        if k
    )
    return float(factors[0].real) + 2 * sum(waves)


def problem(car: br.Car, track: br.Track) -> br.Problem:
    """The control problem of this car's geometry on this track."""
    s = br.ocp.Symbols.of(states=5, inputs=2, stage_parameters=3, parameters=len(PARAMETERS))
    theta = dict(zip(PARAMETERS, ca.vertsplit(s.theta), strict=True))
    e = ca.SX.sym("e", 0)  # no correction

    def rates(x: Any) -> Any:
        arc, n, mu, v, delta = ca.vertsplit(x)
        curvature = curvature_of(track, arc)
        # n is that of the centre of gravity, which does not move where the car points to.
        beta = ca.atan(car.lr_m / car.wheelbase_m * ca.tan(delta))
        along = v * ca.cos(mu + beta) / (1 - n * curvature)
        turn = v * ca.cos(beta) * ca.tan(delta) / car.wheelbase_m
        return ca.vertcat(along, v * ca.sin(mu + beta), turn - curvature * along, s.u)

    def after(h: Any) -> Any:  # a step of Heun's
        k1 = rates(s.x)
        return s.x + h / 2 * (k1 + rates(s.x + h * k1))

    f = ca.Function("f", [s.x, s.u, e], [after(STEP_S)])
    _, n, mu, v, delta = ca.vertsplit(s.x)
    right, left, speed = ca.vertsplit(s.p)
    cost = (
        theta["q_middle"] * n**2
        + theta["q_heading"] * mu**2
        + theta["q_speed"] * (v - speed) ** 2
        + theta["r_acceleration"] * s.u[0] ** 2
        + theta["r_steering"] * s.u[1] ** 2
    )
    lateral = v**2 * ca.tan(delta) / car.wheelbase_m
    most, delta_max = theta["lateral_max"], theta["delta_max"]
    u_max = ca.vertcat(theta["acceleration_max"], theta["rate_max"])
    state, inputs, parameter = br.ocp.State, br.ocp.Input, br.ocp.Parameter
    return br.Problem(
        name="frenet",
        states=(
            state("s", "m"), state("n", "m"), state("mu", "rad"), state("v", "m/s"),
            state("delta", "rad"),
        ),
        inputs=(inputs("a", "m/s2"), inputs("rate", "rad/s", held=False)),
        stage_parameters=(
            parameter("right", "m"), parameter("left", "m"), parameter("speed", "m/s"),
        ),
        parameters=tuple(parameter(one, "1", positive=True) for one in PARAMETERS),
        symbols=s,
        f=f,
        advance=ca.Function("br_advance", [s.x, s.u, e, s.h], [after(s.h)]),
        cost=cost,
        rows=(
            br.ocp.Row("steering", delta, -delta_max, delta_max),
            br.ocp.Row("track", n, -right, left, penalty=theta["w_track"]),
            br.ocp.Row("lateral", lateral, -most, most, penalty=theta["w_lateral"]),
        ),
        u_lower=-u_max,
        u_upper=u_max,
        guess=ca.vertcat(s.share * theta["acceleration_max"] / 4, 0),
        acting=ca.fmin(ca.fmax(s.u, -u_max), u_max),
    )  # fmt: skip


@dataclass(frozen=True)
class Driven:
    """A drive in closed loop, a row for each step."""

    x: Floats
    """The controller's states, shape (n, 5); s counts on from lap to lap."""
    xy: Floats
    u: Floats
    off_track_m: Floats
    """Of the car's centre; negative inside."""
    solve_us: Floats
    usable: Floats
    """1 where the solution was driven, 0 where the plan before was."""
    laps: list[float]
    """Lap times [s], the first from a standing start."""


def stages(track: br.Track, car: br.Car, s: Floats) -> Floats:
    """Parameters of the stages, shape (N, 3), for places along the track (N,)."""
    right, left = track.widths(s)
    inside = car.width_m / 2 + MARGIN_M
    return np.column_stack([right - inside, left - inside, np.full(len(s), SPEED_MPS)])


def drive(mpc: br.Mpc, car: br.Car, track: br.Track) -> Driven:
    """Laps of the simulated car, whose tyres slip: measure, project, solve, act."""
    simulator = br.Simulator(car, track, step_s=STEP_S)
    measured, u = simulator.reset(), np.zeros(2)
    rows: list[list[float]] = []
    s, plan_s, plan_u = 0.0, np.zeros(HORIZON), np.zeros((HORIZON, 2))
    while s < LAPS * track.length_m and len(rows) * STEP_S < 30 * LAPS:
        at = track.project_path([[measured.x, measured.y]], s % track.length_m)
        # How far it has come since the step before, also over the start line.
        half = track.length_m / 2
        s += (float(at.s_m[0]) - s + half) % track.length_m - half
        mu = (measured.psi - float(track.heading(s)) + np.pi) % (2 * np.pi) - np.pi
        speed = np.hypot(measured.vx, measured.vy)
        x = np.array([s, float(at.n_m[0]), mu, speed, measured.delta])
        solution = mpc.step(x, stages(track, car, plan_s), u)
        plan_u = solution.plan_u if solution.usable else np.roll(plan_u, -1, axis=0)
        # Stage k of the next step is stage k + 1 of this one, a step later.
        plan_s = np.append(solution.plan[2:, 0], solution.plan[-1, 0])
        u = plan_u[0]
        place = measured.x, measured.y, float(at.off_track_m[0])
        rows.append([*x, *place, *u, solution.solve_us, float(solution.usable)])
        measured = simulator.step(u)
    table = np.array(rows)
    ends = np.interp(np.arange(LAPS + 1) * track.length_m, table[:, 0], np.arange(len(table)))
    finished = int(table[-1, 0] // track.length_m)
    return Driven(
        table[:, :5], table[:, 5:7], table[:, 8:10], table[:, 7], table[:, 10], table[:, 11],
        (STEP_S * np.diff(ends))[:finished].tolist(),
    )  # fmt: skip


def main(folder: Path) -> dict[str, Any]:
    """Drives, prints what came of it, writes the picture; the drive and its controller."""
    car = br.Car.load("f1tenth")
    track = br.Track.load("workshop", car)
    mpc = br.Mpc(problem(car, track), HORIZON, STEP_S, PARAMETERS, solver=SOLVER)
    driven = drive(mpc, car, track)
    print("laps: " + ", ".join(f"{one:.2f}" for one in driven.laps) + " s")
    outline_m = driven.off_track_m.max() + car.width_m / 2
    print(
        f"states off the track: {int((driven.off_track_m > 0).sum())} of {len(driven.x)}, ", end=""
    )
    print(
        f"the car's side is {abs(outline_m):.2f} m {'out' if outline_m > 0 else 'in'}side at most"
    )
    print(f"speed: up to {driven.x[:, 3].max():.1f} m/s; ", end="")
    print(f"not usable: {int((driven.usable == 0).sum())} of {len(driven.x)} solutions; ", end="")
    print(f"{np.median(driven.solve_us) / 1000:.1f} ms a step")
    picture(driven, car, track).savefig(folder / "frenet.png", dpi=150)
    return {"driven": driven, "mpc": mpc, "car": car, "track": track}


def picture(driven: Driven, car: br.Car, track: br.Track) -> Figure:
    """The way on the track by speed; distance from the middle, and speed, of the last lap."""
    figure = Figure(figsize=(6.4, 8.4), layout="constrained")
    place, across, speed = figure.subplots(3, 1, height_ratios=(2.2, 1, 1))
    draw_way(figure, place, driven, track)
    last = driven.x[:, 0] >= (LAPS - 1) * track.length_m
    s, n, v = (driven.x[last, i] for i in (0, 1, 3))
    s = s - (LAPS - 1) * track.length_m
    right, left = track.widths(s)
    middle = car.width_m / 2
    for most, look in ((0.0, {"color": "#1c1c1a"}), (middle, {"color": "#a0a09a", "ls": "--"})):
        across.plot(s, most - right, **look, label="limit of the car's middle" if most else "edge")
        across.plot(s, left - most, **look)
    across.plot(s, n, color="#0072B2", label="driven")
    across.set(ylabel="from the middle [m]", ylim=(-0.75, 0.75))
    across.legend(ncols=3, fontsize="small", loc="lower center", frameon=False)
    speed.plot(s, v, color="#0072B2")
    speed.set(ylabel="speed [m/s]", xlabel="along the track, last lap [m]", ylim=(0, None))
    for axes in (across, speed):
        axes.set_xlim(0, track.length_m)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def draw_way(figure: Figure, place: Axes, driven: Driven, track: br.Track) -> None:
    """The track and the way of all laps."""
    for edge in track.boundaries(0.05):
        closed = np.vstack([edge, edge[:1]])
        place.plot(closed[:, 0], closed[:, 1], color="#1c1c1a", linewidth=1.2)
    pieces = np.stack([driven.xy[:-1], driven.xy[1:]], axis=1)
    way = LineCollection(list(pieces), cmap="plasma", linewidths=2.0)
    way.set_array(driven.x[:-1, 3])
    place.add_collection(way)
    figure.colorbar(way, ax=place, label="speed [m/s]", location="bottom", shrink=0.8, aspect=40)
    laps = ", ".join(f"{one:.2f}" for one in driven.laps)
    place.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=f"Laps of {laps} s")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
