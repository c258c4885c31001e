"""The largest lateral acceleration that the true car can hold: the one friction number.

    python -m benchmarks.skid_pad

The test that one would make with the real car: the steering angle is held while the duty cycle
rises slowly to full, and speed times yaw rate is noted. Sustained is what the mean over a second
shows. Drag is the drive that straight ahead would accelerate the car and here only holds its speed.
The racing line's only knowledge of the tyres (``CarParameters.friction``) comes from this test;
docs/decisions/2026-11-21-racing-line-limits.md holds the conclusion.
"""

import argparse
from dataclasses import dataclass

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.vehicles import DEFAULT_CAR, CarParameters, get_car
from bayesrace.vehicles.models import dynamic, longitudinal_force
from bayesrace.vehicles.parts import GRAVITY_MPS2
from plant.simulator import Simulator

RAMP_S = 60.0
WINDOW_S = 1.0
START_MPS = 0.5


@dataclass(frozen=True)
class Sustained:
    """The best second of one ramp."""

    delta_rad: float
    friction: float
    """Lateral acceleration over g [-]."""
    speed_mps: float
    radius_m: float
    drag_mps2: float


def ramp(car: CarParameters, delta_rad: float) -> Sustained:
    """Drives with the steering held while the duty cycle rises."""
    simulator = Simulator(dynamic(car))
    turning = START_MPS * delta_rad / car.wheelbase_m
    simulator.reset([0.0, 0.0, 0.0, START_MPS, 0.0, turning, delta_rad])
    duty = np.linspace(0.2, 1.0, round(RAMP_S / simulator.step_s)) * car.d_max
    velocities = np.zeros((len(duty), 3))
    for k, d in enumerate(duty):
        simulator.step((float(d), 0.0))
        velocities[k] = simulator.x[3:6]
    vx, vy, omega = velocities.T
    n = round(WINDOW_S / simulator.step_s)
    speed = np.hypot(vx, vy)
    lateral = moving_mean(speed * omega, n)
    best = int(lateral.argmax())
    v, yaw_rate, forward = (moving_mean(one, n)[best] for one in (speed, omega, vx))
    drive = float(longitudinal_force(car, forward, duty[best + n // 2])) / car.mass_kg
    return Sustained(delta_rad, lateral[best] / GRAVITY_MPS2, v, v / yaw_rate, drive)


def moving_mean(values: Floats, n: int) -> Floats:
    """Means of n values in a row."""
    return np.convolve(values, np.full(n, 1 / n), "valid")


def main() -> None:
    """Prints a row per steering angle and the largest of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--car", default=DEFAULT_CAR)
    car = get_car(parser.parse_args().car)
    print("steering rad  lateral/g  speed m/s  radius m  drag m/s^2")
    results = [ramp(car, share * car.delta_max_rad) for share in np.linspace(0.1, 1.0, 10)]
    for r in results:
        row = f"{r.delta_rad:12.3f}  {r.friction:9.3f}  {r.speed_mps:9.2f}"
        print(f"{row}  {r.radius_m:8.2f}  {r.drag_mps2:10.2f}")
    best = max(results, key=lambda r: r.friction)
    print(f"largest {best.friction:.3f}, in use {car.friction}")


if __name__ == "__main__":
    main()
