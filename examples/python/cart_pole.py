"""GP-MPC of a cart with a pole: the generator knows nothing of cars.

The nominal model has a pole that is too light, no friction, and no cable pulling at the cart. The
controller swings the pole up with it, while some force is added at random. Gaussian processes of
scikit-learn learn from that motion what the model errs by in a step, and correct the same compiled
controller while it stays loaded. A controller with the true model shows what is left to gain.

    python examples/python/cart_pole.py [folder for cart_pole.png]
"""

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

import bayesrace as br

Floats = NDArray[np.float64]

STEP_S: Final = 0.04
HORIZON: Final = 40
DRIVEN_S: Final = 8.0
"""Length of each run."""
MOVE_S: Final = 4.0
MOVE_M: Final = 0.6
"""When and where the cart has to go once the pole stands."""
EXCITED_N: Final = 2.0
"""Standard deviation of the force that is added while samples are collected."""
PARAMETERS: Final = {
    "q_position": 1.0, "q_angle": 4.0, "q_speed": 0.1, "q_rate": 0.1, "q_last": 20.0,
    "r_force": 0.002, "w_rail": 500.0, "rail_m": 1.2, "force_max": 12.0,
}  # fmt: skip


@dataclass(frozen=True)
class CartPole:
    """A cart on a rail and a rod without mass that bears a ball; SI units."""

    pole_kg: float
    friction_n: float
    """Of the cart, beyond a slow speed."""
    cable_n: float
    """With which a cable pulls the cart to the left."""
    cart_kg: float = 0.6
    length_m: float = 0.5

    def rates(self, x: Any, force: Any) -> Any:
        """Derivative of (position, angle from upright, speed, angular rate)."""
        _, angle, speed, rate = ca.vertsplit(x)
        sin, cos, m = ca.sin(angle), ca.cos(angle), self.pole_kg
        push = force - self.friction_n * ca.tanh(speed / 0.2) - self.cable_n
        pole = m * self.length_m * rate**2 * sin - m * 9.81 * sin * cos
        acceleration = (push + pole) / (self.cart_kg + m * sin**2)
        turn = (9.81 * sin - acceleration * cos) / self.length_m
        return ca.vertcat(speed, rate, acceleration, turn)

    def after(self, x: Any, force: Any, h: Any) -> Any:
        """State after ``h`` seconds under a constant force: one step of Runge and Kutta."""
        k1 = self.rates(x, force)
        k2 = self.rates(x + h / 2 * k1, force)
        k3 = self.rates(x + h / 2 * k2, force)
        k4 = self.rates(x + h * k3, force)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


TRUE: Final = CartPole(pole_kg=0.3, friction_n=1.0, cable_n=1.0)
NOMINAL: Final = CartPole(pole_kg=0.2, friction_n=0.0, cable_n=0.0)


def problem(name: str, model: CartPole) -> br.Problem:
    """The control problem with one prediction model, and room for a correction of two states."""
    s = br.ocp.Symbols.of(states=4, inputs=1, stage_parameters=1, parameters=len(PARAMETERS))
    theta = dict(zip(PARAMETERS, ca.vertsplit(s.theta), strict=True))
    e = ca.SX.sym("e", 2)  # what the Gaussian processes add to speed and rate in a step

    def after(h: Any) -> Any:
        # A speed that has grown by e at the end of the step has moved the cart by h / 2 e more.
        return model.after(s.x, s.u, h) + ca.vertcat(h / 2 * e, e)

    f = ca.Function("f", [s.x, s.u, e], [after(STEP_S)])
    position, angle, speed, rate = ca.vertsplit(s.x)
    # Squares, not 1 - cos(angle): where the exact Hessian of the problem is indefinite, the step
    # takes that of the cost, which therefore has to be convex.
    state_cost = (
        theta["q_position"] * (position - s.p) ** 2
        + theta["q_angle"] * angle**2
        + theta["q_speed"] * speed**2
        + theta["q_rate"] * rate**2
    )
    force_max, rail = theta["force_max"], theta["rail_m"]
    return br.Problem(
        name=name,
        states=(
            br.ocp.State("position", "m"),
            br.ocp.State("angle", "rad"),
            br.ocp.State("speed", "m/s"),
            br.ocp.State("rate", "rad/s"),
        ),
        inputs=(br.ocp.Input("force", "N"),),
        stage_parameters=(br.ocp.Parameter("target", "m"),),
        parameters=tuple(br.ocp.Parameter(one, "1", positive=True) for one in PARAMETERS),
        features=("angle", "speed", "rate", "force"),
        outputs=2,
        symbols=s,
        f=f,
        advance=ca.Function("br_advance", [s.x, s.u, e, s.h], [after(s.h)]),
        cost=state_cost * (1 + theta["q_last"] * s.last) + theta["r_force"] * s.u**2,
        rows=(br.ocp.Row("rail", position, -rail, rail, penalty=theta["w_rail"]),),
        u_lower=-force_max,
        u_upper=force_max,
        guess=s.share * force_max,
        acting=ca.fmin(ca.fmax(s.u, -force_max), force_max),
    )


@dataclass(frozen=True)
class Motion:
    """One run in closed loop."""

    x: Floats
    """States, shape (n + 1, 4)."""
    u: Floats
    """Forces, shape (n, 1)."""
    solve_us: Floats
    usable: int

    @property
    def upright_s(self) -> float:
        """From when on the pole stays within 15 degrees of upright; infinity if it does not."""
        tilted = np.flatnonzero(np.abs(self.x[:, 1]) > np.radians(15))
        return float("inf") if tilted[-1] == len(self.x) - 1 else STEP_S * float(tilted[-1] + 1)

    @property
    def offset_m(self) -> float:
        """How far the cart is from its target during the last second, on average."""
        return float(np.abs(self.x[-round(1 / STEP_S) :, 0] - MOVE_M).mean())

    def __str__(self) -> str:
        return (
            f"upright after {self.upright_s:.2f} s, {100 * self.offset_m:4.1f} cm from its target "
            f"at the end, {np.median(self.solve_us):.0f} us a step"
        )


def targets(k: int) -> Floats:
    """Where the cart shall be at the stages of step k, shape (N, 1)."""
    t = (k + 1 + np.arange(HORIZON)) * STEP_S
    return np.where(t < MOVE_S, 0.0, MOVE_M)[:, None]


def simulated(mpc: br.Mpc, excited_n: float = 0.0) -> Motion:
    """The true system from rest, its pole hanging, under this controller."""
    state, force = ca.SX.sym("x", 4), ca.SX.sym("u")
    fine = ca.Function("fine", [state, force], [TRUE.after(state, force, STEP_S / 10)])
    plant, random = fine.mapaccum(10), np.random.default_rng(0)
    limit = PARAMETERS["force_max"]
    x, u = [np.array([0.0, np.pi, 0.0, 0.0])], [np.zeros(1)]
    times, usable = [], 0
    mpc.reset()
    for k in range(round(DRIVEN_S / STEP_S)):
        solution = mpc.step(x[-1], targets(k), u[-1])
        times.append(solution.solve_us)
        usable += solution.usable
        u.append(np.clip(solution.u + random.normal(0, excited_n, 1), -limit, limit))
        x.append(np.asarray(plant(x[-1], np.tile(u[-1], (1, 10))))[:, -1])
    return Motion(np.array(x), np.array(u[1:]), np.array(times), usable)


def samples(model: br.Problem, motion: Motion) -> tuple[Floats, Floats]:
    """Features (n, 4) of a motion, and what the model errs by in speed and rate (n, 2)."""
    x, u = motion.x, motion.u
    # One call for all columns; no correction.
    predicted = np.asarray(model.f(x[:-1].T, u.T, np.zeros((2, 1))))
    return np.column_stack([x[:-1, 1:], u]), x[1:, 2:] - predicted[2:].T


def learned(z: Floats, errors: Floats) -> list[GaussianProcessRegressor]:
    """A Gaussian process for each output."""
    kernel = ConstantKernel() * RBF([1.0, 1.0, 5.0, 10.0], (0.5, 100.0)) + WhiteKernel(
        1e-3, (1e-4, 1.0)
    )
    with warnings.catch_warnings():
        # The bounds are meant: shorter lengths and less noise fit the samples, but nothing else.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return [GaussianProcessRegressor(kernel, normalize_y=True).fit(z, one) for one in errors.T]


def main(folder: Path) -> dict[str, Any]:
    """Runs it all, prints what came of it, writes the picture; the motions and the controllers."""
    mpc = br.Mpc(problem("cart_pole", NOMINAL), HORIZON, STEP_S, PARAMETERS)
    perfect = br.Mpc(problem("cart_pole_perfect", TRUE), HORIZON, STEP_S, PARAMETERS)
    motions = {"nominal": simulated(mpc)}
    regressors = learned(*samples(mpc.problem, simulated(mpc, EXCITED_N)))
    mpc.set_regressors(regressors)
    motions |= {"corrected": simulated(mpc), "perfect model": simulated(perfect)}
    for name, motion in motions.items():
        print(f"{name:>13}: {motion}")
    z, errors = samples(mpc.problem, motions["corrected"])
    left = errors - np.column_stack([one.predict(z) for one in regressors])
    share = np.sqrt(np.mean(left**2, axis=0) / np.mean(errors**2, axis=0))
    print(
        f"errors of the model that the correction leaves: {share[0]:.1%} of the speed's, ", end=""
    )
    print(f"{share[1]:.1%} of the rate's")
    picture(motions).savefig(folder / "cart_pole.png", dpi=150)
    return {"motions": motions, "regressors": regressors, "mpc": mpc, "left": share}


def picture(motions: dict[str, Motion]) -> Figure:
    """Angle, position and force over time."""
    looks: Sequence[tuple[str, str]] = (("#D55E00", "-"), ("#0072B2", "-"), ("#3d3d3a", "--"))
    figure = Figure(figsize=(6.4, 7.2), layout="constrained")
    angle, position, force = figure.subplots(3, 1, sharex=True)
    t = STEP_S * np.arange(round(DRIVEN_S / STEP_S) + 1)
    position.step(t, np.where(t < MOVE_S, 0.0, MOVE_M), color="#a0a09a", label="target")
    for rail in (-PARAMETERS["rail_m"], PARAMETERS["rail_m"]):
        position.axhline(rail, color="#1c1c1a", linewidth=0.8)
    angle.set_yticks([0, 90, 180])
    for (name, motion), (colour, style) in zip(motions.items(), looks, strict=True):
        look: dict[str, Any] = {"color": colour, "linestyle": style, "label": name}
        angle.plot(t, np.degrees(motion.x[:, 1]), **look)
        position.plot(t, motion.x[:, 0], **look)
        force.step(t[:-1], motion.u[:, 0], where="post", **look)
    angle.set(ylabel="pole from upright [°]", title="A pole swung up, and its cart moved")
    position.set(ylabel="cart [m]", ylim=(-1.4, 1.4))
    force.set(ylabel="force [N]", xlabel="time [s]", xlim=(0, DRIVEN_S))
    position.legend(ncols=2, fontsize="small", loc="lower right")
    for axes in (angle, position, force):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
