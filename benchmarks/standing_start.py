"""Does a car drive off again wherever it stands, and after braking without states?

    python -m benchmarks.standing_start                           built-in track, 200 of each
    python -m benchmarks.standing_start --track ethz.csv --train-track ethzmobil.csv

First random poses up to .6 m beside the racing line, pointing anywhere, half of them standing:
after 15 s the car has to drive along its line. Then one long drive in which the states are lost
time and again, for up to 1.6 s: four seconds after each loss it has to be driving. Driver,
fallback, compiled step and simulated car in one process; no clock.
"""

import argparse
from collections.abc import Iterator
from typing import Final

import numpy as np
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.gp.weights import read_weights
from bayesrace.messages import State
from bayesrace.raceline import RaceLine
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK
from bayesrace.vehicles import DEFAULT_CAR, get_car
from bayesrace.vehicles.models import dynamic
from controller.assembly import compiled_controller
from controller.cycle import Cycle
from controller.cycle_settings import CompensationSettings
from controller.mpc import PredictiveController
from controller.process_settings import ControllerSettings
from operation.preparation import prepare
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on
from plant.simulator import Simulator

ASIDE_M: Final = 0.6
LATER: Final = 750
"""Cycles after which a car has to be driving."""
BLIND: Final = 80
"""Longest loss of states, in cycles."""
AFTER_LOSS: Final = 200
SECOND: Final = 50
DRIVEN_OFF_M: Final = 0.5
"""Progress along the line within a second."""
STALE_S: Final = 0.1


class Rig:
    """A driver and its car."""

    def __init__(self, controller: PredictiveController, length_m: float) -> None:
        car = get_car(DEFAULT_CAR)
        self._length_m = length_m
        compensation = CompensationSettings(mode="fixed", delay_s=0.0)
        settings = ControllerSettings(compensation=compensation, stale_s=STALE_S)
        self._driver = Cycle(controller, car, settings).driver
        self.car = Simulator(dynamic(car))
        self._run = 0

    def place(self, x: Floats) -> None:
        """Begins a new run there."""
        self.car.reset(x.tolist())
        self._run += 1

    def cycles(self, count: int, blind: bool = False) -> None:
        """Drives; ``blind``: no state arrives."""
        driver = self._driver
        for _ in range(count):
            state = State(
                seq=self.car.steps,
                source_time_ns=0,
                epoch=1,
                run=self._run,
                time_s=self.car.time_s,
                x=tuple(self.car.x),
                u_applied=self.car.u_applied,
                lap=0,
                lockstep=False,
                actuation_delays=(),
                final=False,
            )
            if not blind:
                driver.observe(state)
            decision = driver.decide(state.time_s)
            self.car.step((decision.d, decision.delta_rate))

    def has_driven_off(self) -> bool:
        """Whether the next second brings it on along the line."""
        self.cycles(1)
        before_m = self._where_m()
        self.cycles(SECOND)
        ahead_m = (self._where_m() - before_m) % self._length_m
        return DRIVEN_OFF_M < ahead_m < self._length_m / 2

    def _where_m(self) -> float:
        output = self._driver.output
        return 0.0 if output is None else output.s_ref_m


def poses(line: RaceLine, count: int, random: np.random.Generator) -> Iterator[Floats]:
    """Beside the line, pointing anywhere; half of them stand, the others roll."""
    for _ in range(count):
        i = random.integers(len(line.x_m))
        psi, n = line.psi_rad[i], random.uniform(-ASIDE_M, ASIDE_M)
        x, y = line.x_m[i] - n * np.sin(psi), line.y_m[i] + n * np.cos(psi)
        speed = random.choice([0.0, 0.0, 0.3, 1.0])
        yield np.array(
            [x, y, psi + random.uniform(-np.pi, np.pi), speed, 0, 0, random.uniform(-0.35, 0.35)]
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--train-track", default=DEFAULT_TRAINING_TRACK)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    console = Console()
    with stages_on(console) as stages:
        settings = PreparationSettings(train_track=given.train_track)
        made = prepare(settings, (given.track,), stages)
    car, track, line = get_car(DEFAULT_CAR), made.first.track, made.first.line
    weights = read_weights(made.weights)
    controller = compiled_controller(made.artefacts[0], car, track, line, weights)
    rig, random = Rig(controller, line.length_m), np.random.default_rng(given.seed)
    stood = 0
    for x in poses(line, given.count, random):
        rig.place(x)
        rig.cycles(LATER)
        if not rig.has_driven_off():
            stood += 1
            console.print(f"not driving from {x.round(3).tolist()}")
    console.print(f"{track.name}: {stood} of {given.count} poses not driving after 15 s")
    rig.place(np.array([line.x_m[0], line.y_m[0], line.psi_rad[0], 0.0, 0, 0, 0]))
    stood = 0
    for _ in range(given.count):
        rig.cycles(int(random.integers(20, 200)))
        rig.cycles(int(random.integers(5, BLIND)), blind=True)
        rig.cycles(AFTER_LOSS)
        stood += not rig.has_driven_off()
    console.print(f"{track.name}: {stood} of {given.count} losses of the state not overcome")


if __name__ == "__main__":
    main()
