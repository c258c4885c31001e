"""The car as an FMU beside the built-in equations: time of a period, and the laps.

    python -m benchmarks.fmu                                              built-in tracks
    python -m benchmarks.fmu --track ethz.csv --train-track ethzmobil.csv
    python -m benchmarks.fmu --no-laps                                    the times alone

A period is what the plant does every 20 ms: two inputs set, one step (20 sub-steps of RK4), seven
outputs read. It is timed for the built-in car, for its FMU called by fmpy in this process, and for
the FMU in a worker process, as ``bayesrace plant --fmu`` has it. Then the BayesRace controller
drives two laps of each car, in one process, and the states are compared; and the controller as an
FMU drives the car as an FMU, stepped by nothing but fmpy.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from rich.console import Console
from rich.table import Table

from bayesrace.gp.weights import read_weights
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK
from bayesrace.vehicles import DEFAULT_CAR, get_car
from bayesrace.vehicles.models import STATES, dynamic
from codegen.fmu import car_fmu, controller_fmu, pack
from controller.cycle_settings import FallbackSettings
from controller.path_table import make_path_table
from controller.settings import MpcSettings
from operation.closed_loop import Driven, drive_compiled
from operation.preparation import Prepared, prepare
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on
from plant.fmu.simulator import open_fmu
from plant.simulator import PLANT, Simulator

VERSIONS: Final[tuple[Literal[2, 3], ...]] = (2, 3)
STEP_S: Final = PLANT.step_s
PERIODS, WARM_UP = 20_000, 500
INPUTS: Final = ("d", "delta_rate")
START: Final = (0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0)


class Slave:
    """An FMU of ours, called by fmpy alone; ``start`` its values before initialisation."""

    def __init__(self, fmu: Path, folder: Path, start: dict[str, float]) -> None:
        fmpy.extract(str(fmu), unzipdir=str(folder))
        description = fmpy.read_model_description(str(folder))
        references = {v.name: v.valueReference for v in description.modelVariables}
        self._references = references
        two = description.fmiVersion.startswith("2")
        self.fmu: Any = (FMU2Slave if two else FMU3Slave)(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="benchmark",
        )
        self.fmu.instantiate()
        if two:
            self.fmu.setupExperiment(startTime=0.0)
        self._set = self.fmu.setReal if two else self.fmu.setFloat64
        self._get = self.fmu.getReal if two else self.fmu.getFloat64
        self._set([references[name] for name in start], list(start.values()))
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self._steps = 0

    def exchange(
        self, inputs: tuple[str, ...], outputs: tuple[str, ...]
    ) -> Callable[[list[float]], list[float]]:
        """A function that sets these inputs, makes a step and reads these outputs."""
        to, of = ([self._references[name] for name in names] for names in (inputs, outputs))

        def step(values: list[float]) -> list[float]:
            self._set(to, values)
            self.fmu.doStep(
                currentCommunicationPoint=self._steps * STEP_S, communicationStepSize=STEP_S
            )
            self._steps += 1
            return list(self._get(of))

        return step

    def read(self, outputs: tuple[str, ...]) -> list[float]:
        """Values of these outputs now."""
        return list(self._get([self._references[name] for name in outputs]))

    def close(self) -> None:
        """Ends and frees the instance."""
        self.fmu.terminate()
        self.fmu.freeInstance()


@contextmanager
def slave(fmu: Path, start: dict[str, float]) -> Iterator[Slave]:
    """A :class:`Slave` for the block."""
    with tempfile.TemporaryDirectory() as folder:
        made = Slave(fmu, Path(folder), start)
        yield made
        made.close()


def times_us(step: Callable[[list[float]], object]) -> tuple[float, float]:
    """Median and 99th percentile of a period under changing inputs."""
    taken = np.zeros(PERIODS)
    for k in range(-WARM_UP, PERIODS):
        u = [0.4, 4.0 * np.sin(0.1 * k)]
        begin_ns = time.perf_counter_ns()
        step(u)
        taken[k] = (time.perf_counter_ns() - begin_ns) * 1e-3
    median, p99 = np.percentile(taken, (50, 99))
    return float(median), float(p99)


def print_times(fmus: dict[str, Path], console: Console) -> None:
    """One row for each way to have a period computed."""
    car = get_car(DEFAULT_CAR)
    table = Table("one period of 20 ms", "median µs", "p99 µs")
    simulator = Simulator(dynamic(car))
    simulator.reset(START)
    rows = [("built-in car", times_us(simulator.step))]
    for name, fmu in fmus.items():
        with slave(fmu, dict(zip(STATES, START, strict=True))) as one:
            rows.append((f"{name}, fmpy", times_us(one.exchange(INPUTS, STATES))))
    for name, fmu in fmus.items():
        with open_fmu(car, fmu) as vehicle:
            vehicle.reset(START)
            rows.append((f"{name}, worker process", times_us(vehicle.step)))
    for label, (median, p99) in rows:
        table.add_row(label, f"{median:.1f}", f"{p99:.1f}")
    console.print(table)


def master(car: Path, controller: Path, x0: list[float], periods: int) -> np.ndarray:
    """States (periods + 1, 7) of the car's FMU driven by the controller's, by fmpy alone."""
    with slave(car, dict(zip(STATES, x0, strict=True))) as plant, slave(controller, {}) as driver:
        drives, decides = plant.exchange(INPUTS, STATES), driver.exchange(STATES, INPUTS)
        states = [plant.read(STATES)]
        for _ in range(periods):
            states.append(drives(decides(states[-1])))
    return np.array(states)


def print_laps(fmus: dict[str, Path], prepared: Prepared, folder: Path, console: Console) -> None:
    """Two laps of each car, and how far apart their states are at most."""
    car = get_car(DEFAULT_CAR)
    artefact, first = prepared.artefacts[0], prepared.first
    track, line, weights = first.track, first.line, read_weights(prepared.weights)
    table = Table(f"{track.name}, BayesRace", "laps s", "off track", "largest difference")

    def row(name: str, own: Driven, x: np.ndarray) -> None:
        count = min(len(x), len(reference.x))
        apart = float(np.abs(x[:count] - reference.x[:count]).max())
        laps = " ".join(f"{lap:.3f}" for lap in own.laps_s)
        table.add_row(name, laps, str(int((own.off_track_m > 0).sum())), f"{apart:.3g}")

    reference = drive_compiled(artefact, track, line, weights, car=car)
    row("built-in car", reference, reference.x)
    for name, fmu in fmus.items():
        with open_fmu(car, fmu) as vehicle:
            own = drive_compiled(artefact, track, line, weights, car=car, vehicle=vehicle)
        row(name, own, own.x)
    path = make_path_table(track, line, car.tuning.path.spacing_m)
    x0 = reference.x[0].tolist()
    for version, fmu in zip(VERSIONS, fmus.values(), strict=True):
        definition = controller_fmu(
            artefact, car, rows=path.rows, spacing_m=path.spacing_m,
            settings=MpcSettings().parameters(car),
            fallback=FallbackSettings().model_dump() | {"brake_fade_mps": car.brake_fade_mps},
            weights=weights, version=version,
        )  # fmt: skip
        controller = pack(definition, folder / f"controller-{version}.fmu")
        x = master(fmu, controller, x0, len(reference.x) - 1)
        apart = float(np.abs(x - reference.x).max())
        table.add_row(f"car and controller, FMI {version}.0, fmpy", "", "", f"{apart:.3g}")
    console.print(table)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--train-track", default=DEFAULT_TRAINING_TRACK)
    parser.add_argument("--laps", action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    console = Console()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        fmus = {
            f"FMI {n}.0": pack(car_fmu(get_car(DEFAULT_CAR), n), folder / f"car{n}.fmu")
            for n in VERSIONS
        }
        print_times(fmus, console)
        if not options.laps:
            return
        settings = PreparationSettings(train_track=options.train_track)
        with stages_on(console) as stages:
            prepared = prepare(settings, (options.track,), stages)
        print_laps(fmus, prepared, folder, console)


if __name__ == "__main__":
    main()
