"""Laps of the compiled controller and the simulated car in one process: no transport, no clock.

What the benchmarks of decisions share; lap times are those of ``bayesrace race`` in lockstep.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesrace.gp.weights import GpWeights
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.models import dynamic
from controller.native_step import NativeStep
from controller.path_table import make_path_table
from controller.settings import MpcSettings
from experiments.analysis import time_laps
from experiments.collect import drive_samples
from experiments.settings import RaceSettings
from learning.dataset import Dataset, filter_dataset
from plant.simulator import Simulator
from plant.vehicle import Vehicle

__all__ = ["Drive", "drive", "pursue"]

START_MPS = 0.1
LIMIT = 3.0
"""A drive ends at this multiple of the racing line's time a lap."""


@dataclass(frozen=True, eq=False)
class Drive:
    """States (n + 1, 7), inputs that acted (n, 2), lap times [s], and how it went."""

    x: NDArray[np.float64]
    u: NDArray[np.float64]
    laps_s: tuple[float, ...]
    off_track: int
    off_track_max_m: float
    unusable: int
    """Steps without a usable solution; the car braked."""
    step_us: NDArray[np.float64]
    second_starts: int
    """Steps that looked for another plan beside the one that went on from before."""

    def samples(self, car: CarParameters, step_s: float) -> Dataset:
        """What can be learned from."""
        return filter_dataset(Dataset(car, step_s, self.x[:-1], self.u, self.x[1:]))

    def __str__(self) -> str:
        laps = " ".join(f"{t:.3f}" for t in self.laps_s) or "did not finish"
        text = f"{laps} s, {self.off_track} off track"
        if self.off_track:
            text += f" (deepest {1e3 * self.off_track_max_m:.0f} mm)"
        return text + (f", {self.unusable} unusable" if self.unusable else "")


def drive(
    artefact: Path,
    car: CarParameters,
    track: Track,
    line: RaceLine,
    weights: GpWeights | None = None,
    laps: int = 2,
    vehicle: Vehicle | None = None,
) -> Drive:
    """Drives from the start line until the laps are done or time is up.

    ``vehicle``: what plays the car; the built-in equations without.
    """
    step, simulator = NativeStep(artefact, car, MpcSettings()), vehicle or Simulator(dynamic(car))
    step.set_path(make_path_table(track, line, car.tuning.path.spacing_m))
    if weights is not None:
        step.set_weights(weights)
    step.reset()
    x, y, psi = track.start_pose()
    simulator.reset([x, y, psi, START_MPS, 0.0, 0.0, 0.0])
    states, inputs, unusable, second = [simulator.x.copy()], [], 0, 0
    step_us: list[float] = []
    times: tuple[float, ...] = ()
    after = 0
    while len(times) < laps and simulator.time_s < LIMIT * line.lap_time_s * laps:
        begin_ns = time.perf_counter_ns()
        status = step.step(simulator.x, simulator.u_applied[0])
        step_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
        unusable += not status.usable
        second += step.info.second_start > 0
        simulator.step(step.u.tolist() if status.usable else None)
        states.append(simulator.x.copy())
        inputs.append(simulator.u_applied)
        if simulator.steps % 50 == 0:
            times, after = _laps(track, np.array(states), simulator.step_s)
    times, after = times[:laps], after or len(states)
    off = track.project_path(np.array(states)[:after, :2]).off_track_m
    return Drive(
        np.array(states), np.array(inputs), times, int((off > 0).sum()),
        max(0.0, float(off.max())), unusable, np.array(step_us), second,
    )  # fmt: skip


def _laps(
    track: Track, states: NDArray[np.float64], step_s: float
) -> tuple[tuple[float, ...], int]:
    """Lap times so far, and the number of samples up to the last crossing."""
    xy = states[:, :2]
    time_s = step_s * np.arange(len(xy), dtype=np.float64)
    found = time_laps(track, time_s, xy, track.project_path(xy).s_m)
    return found.times_s, found.after[-1] if found.after else 0


def pursue(car: CarParameters, track: Track, line: RaceLine, step_s: float) -> Dataset:
    """The training drive of ``bayesrace race``, with its defaults."""
    settings = RaceSettings()
    x, u = drive_samples(track, line, car, car.tuning.pursuit.drive_s, settings.pursuit)
    return filter_dataset(Dataset(car, step_s, x[:-1], u, x[1:]))
