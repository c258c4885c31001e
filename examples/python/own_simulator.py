"""A simulator of one's own: tyres that no car file describes.

The car has brush tyres (Fiala) and a front axle that is loaded when it brakes, in twenty lines of
NumPy. The controller knows geometry, motor and friction. It drives the simulator without a
correction, which leads it off the track, learns from that, and drives again.

    python examples/python/own_simulator.py [folder for own_simulator.png]
"""

import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import bayesrace as br

Floats = NDArray[np.float64]

GRAVITY_MPS2: Final = 9.81
SUBSTEPS: Final = 20
"""Of a period: the tyres are stiff."""


class BrushTyres:
    """What ``br.drive`` drives: ``reset`` and ``step``."""

    step_s = 0.02
    stiffness_n = 4.0
    """Lateral force over the slip angle, of an axle [N/rad]."""
    friction = 0.75
    """Of the tyres [-]."""
    height_m = 0.012
    """Of the centre of gravity."""

    def __init__(self, car: br.Car) -> None:
        self._car, self._x = car, np.zeros(7)

    def reset(self, x0: Floats) -> Floats:
        """The state (7,) that the car begins in."""
        self._x = x0.copy()
        return self._x

    def step(self, u: Floats) -> Floats:
        """The state (7,) after a period with this input (2,) held."""
        h = self.step_s / SUBSTEPS
        for _ in range(SUBSTEPS):  # the classical Runge-Kutta method
            k1 = self._rates(self._x, u)
            k2 = self._rates(self._x + h / 2 * k1, u)
            k3 = self._rates(self._x + h / 2 * k2, u)
            k4 = self._rates(self._x + h * k3, u)
            self._x = self._x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return self._x

    def _rates(self, x: Floats, u: Floats) -> Floats:
        """Of the single-track model: dx/dt (7,)."""
        car, (_, _, psi, vx, vy, omega, delta), (d, delta_rate) = self._car, x, u
        drive: Any = car.drive
        force = (drive.cm1 - drive.cm2 * vx) * d - drive.cr0 * np.tanh(10 * vx) - drive.cr2 * vx**2
        rolling = max(vx, 0.05)
        moved_n = force * self.height_m / car.wheelbase_m
        weight_n = car.mass_kg * GRAVITY_MPS2 / car.wheelbase_m
        front = self._axle(np.arctan2(vy + car.lf_m * omega, rolling) - delta,
                           weight_n * car.lr_m - moved_n)  # fmt: skip
        rear = self._axle(np.arctan2(vy - car.lr_m * omega, rolling), weight_n * car.lf_m + moved_n)
        inertia = car.inertia_kgm2 or 1.0
        return np.array([
            vx * np.cos(psi) - vy * np.sin(psi),
            vx * np.sin(psi) + vy * np.cos(psi),
            omega,
            (force - front * np.sin(delta)) / car.mass_kg + vy * omega,
            (rear + front * np.cos(delta)) / car.mass_kg - vx * omega,
            (front * car.lf_m * np.cos(delta) - rear * car.lr_m) / inertia,
            delta_rate,
        ])  # fmt: skip

    def _axle(self, slip_rad: float, load_n: float) -> float:
        """Fiala's lateral force: a cubic of the slip up to where all of the contact slides."""
        most, slope = self.friction * max(load_n, 0.0), self.stiffness_n * np.tan(slip_rad)
        if abs(slope) >= 3 * most:
            return float(-most * np.sign(slope))
        return float(-slope + slope * abs(slope) / (3 * most) - slope**3 / (27 * most**2))


def main(folder: Path) -> dict[str, br.Run]:
    """The runs before and after learning; writes the picture."""
    car, track = br.Car.load("orca"), br.Track.load("workshop")
    controller, simulator = br.Controller(car, track), BrushTyres(car)
    runs = {"uncorrected": br.drive(controller, simulator, laps=2)}
    for name in ("learned", "updated"):
        controller.weights = br.train(list(runs.values()), initial=controller.weights)
        runs[name] = br.drive(controller, simulator, laps=2)
    for name, run in runs.items():
        print(f"{name}: {run}")
    picture(runs, track).savefig(folder / "own_simulator.png", dpi=150)
    return runs


def picture(runs: dict[str, br.Run], track: br.Track) -> Figure:
    """Where the car went before and after learning; its speed on the last lap."""
    figure = Figure(figsize=(6.4, 8.2), layout="constrained")
    place, speed = figure.subplots(2, 1, height_ratios=(2, 1))
    for edge in track.boundaries():
        place.plot(*edge.T, color="0.6", linewidth=1)
    for (name, run), colour in zip(runs.items(), ("#D55E00", "#0072B2", "#009E73"), strict=True):
        place.plot(run.x[:, 0], run.x[:, 1], color=colour, linewidth=1.2, label=name)
        if run.laps:
            last = run.t >= sum(run.laps[:-1])
            s_m = track.project_path(run.x[last, :2]).s_m
            order = np.argsort(s_m)
            speed.plot(s_m[order], run.x[last, 3][order], color=colour, label=name)
    place.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Brush tyres on 'workshop'")
    speed.set(xlabel="along the track, last lap [m]", ylabel="speed [m/s]")
    for axes in (place, speed):
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
