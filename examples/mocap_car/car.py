"""A car and the cameras that see it, simulated: hardware to mocap_plant.py. See README.md.

The car is BayesRace's simulator. It knows no runs and no messages of BayesRace, has a clock of its
own, and brakes when no command has come for 0.2 s. SIGUSR1 blinds the cameras, and again: they see.
"""

import argparse
import signal
import socket
import time
from collections import deque
from pathlib import Path

import numpy as np
from mocap_plant import COMMAND, DELAY_S, DEVIATION, POSE, address

from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic

STEP_HZ, POSE_HZ = 500, 100
WATCHDOG_S = 0.2
CLOCK_S, CLOCK_RATE = 5000.0, 1 + 50e-6  # the cameras' clock: what it shows at the start, its rate


class Car:
    """Actuators and what they move."""

    def __init__(self, name: str, track: str) -> None:
        self.simulator = Simulator(dynamic(get_car(name)), plant_discretisation(STEP_HZ))
        x, y, psi = load_track(track).start_pose()
        ahead_m = 2 * self.simulator.car.wheelbase_m  # of the start line
        self.simulator.reset(
            (x + ahead_m * np.cos(psi), y + ahead_m * np.sin(psi), psi, 0, 0, 0, 0)
        )
        self._command, self._heard_s = (0.0, 0.0, 0.0), -WATCHDOG_S

    def command(self, d: float, delta_rad: float, rate_radps: float) -> None:
        """Held until the next."""
        self._command, self._heard_s = (d, delta_rad, rate_radps), self.simulator.time_s

    def step(self) -> None:
        """2 ms: the servo turns at the commanded rate until it is there."""
        simulator, (d, delta_rad, rate) = self.simulator, self._command
        if simulator.time_s - self._heard_s > WATCHDOG_S:
            simulator.step(None)
        else:
            wanted = (delta_rad - simulator.x[6]) / simulator.step_s
            simulator.step((d, min(max(wanted, -rate), rate)))


def simulate(car: Car, link: socket.socket, to: tuple[str, int], lost: float, out: Path) -> None:
    """In real time, until SIGTERM; the true states go to a file."""
    random, seen, over = np.random.default_rng(0), True, False
    waiting: deque[tuple[float, bytes]] = deque()  # pictures that are still being evaluated

    def on_signal(number: int, _frame: object) -> None:
        nonlocal seen, over
        over |= number != signal.SIGUSR1
        seen ^= number == signal.SIGUSR1

    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        signal.signal(one, on_signal)
    simulator, deviation, start_s = car.simulator, [*DEVIATION.values()], time.monotonic()
    with out.open("w", buffering=1) as truth:
        while not over:
            time.sleep(max(start_s + simulator.time_s - time.monotonic(), 0.0))
            try:
                while True:
                    car.command(*COMMAND.unpack(link.recv(COMMAND.size)))
            except BlockingIOError:
                pass
            if simulator.steps % (STEP_HZ // POSE_HZ) == 0:
                pose = random.normal(simulator.x[:3], deviation)
                clock_s = CLOCK_S + CLOCK_RATE * simulator.time_s
                if seen and random.random() >= lost:
                    waiting.append((simulator.time_s + DELAY_S, POSE.pack(clock_s, *pose)))
                truth.write(",".join(f"{one:.6g}" for one in (clock_s, *simulator.x)) + "\n")
            while waiting and waiting[0][0] <= simulator.time_s:
                link.sendto(waiting.popleft()[1], to)
            car.step()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--car", default="orca", help="built-in car, or its file")
    parser.add_argument("--track", default="harbour", help="where it stands, past the start line")
    parser.add_argument("--poses", type=address, default="127.0.0.1:7500", help="they go there")
    parser.add_argument("--commands", type=address, default="127.0.0.1:7501", help="arrive here")
    parser.add_argument("--lost", type=float, default=0.01, help="share of the poses that is lost")
    parser.add_argument("--truth", type=Path, default=Path("truth.csv"), help="true states")
    given = parser.parse_args()
    hardware = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    hardware.bind(given.commands)
    hardware.setblocking(False)
    simulate(Car(given.car, given.track), hardware, given.poses, given.lost, given.truth)
