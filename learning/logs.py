"""Datasets from run logs and from logged messages."""

import itertools
import os
from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np

from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import STATE, TELEMETRY, State, Telemetry, car_key
from bayesrace.vehicles.parameters import CarParameters
from learning.dataset import Dataset, FilterSettings, filter_dataset

__all__ = ["dataset_from_log", "dataset_from_messages"]


def dataset_from_messages(
    states: Iterable[State],
    telemetry: Iterable[Telemetry],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    settings: FilterSettings | None = None,
) -> Dataset:
    """Filtered samples from consecutive states of the same run (all runs, or those named).

    The input of sample k is ``u_applied`` of the state after it: what acted, not what was asked.
    A missing state ends the stretch ("gap"); cycles driven by the fallback are left out.
    """
    fallback = {(m.run, m.state_seq) for m in telemetry if m.fallback > 0}
    wanted = [state for state in states if runs is None or state.run in runs]
    x, u, x_next, driven = [], [], [], []
    gaps = 0
    for now, after in itertools.pairwise(wanted):
        if now.run != after.run or (after.final and after.time_s == now.time_s):
            continue  # a fault of the plant repeats the last state: no time has passed
        if after.seq != now.seq + 1 or abs(after.time_s - now.time_s - step_s) > 1e-6:
            gaps += 1
            continue
        x.append(now.x)
        u.append(after.u_applied)
        x_next.append(after.x)
        driven.append((now.run, now.seq) not in fallback)
    if not x:
        raise InputError("the log has no two consecutive states; was the car driven?")
    dropped = {"gap": gaps} if gaps else {}
    samples = Dataset(car, step_s, np.array(x), np.array(u), np.array(x_next), dropped)
    return filter_dataset(samples.select(np.array(driven), "fallback"), settings)


def dataset_from_log(
    path: str | os.PathLike[str],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    settings: FilterSettings | None = None,
) -> Dataset:
    """Filtered samples of ``car`` from a run's MCAP log; see :func:`dataset_from_messages`.

    InputError if it is no log or holds no driving of this car.
    """
    reader = LogReader(Path(path))
    keys = {car_key(topic.key, car.name) for topic in (STATE, TELEMETRY)}
    states: list[State] = []
    telemetry: list[Telemetry] = []
    for entry in reader.messages((STATE, TELEMETRY)):
        if entry.key not in keys:
            continue
        if isinstance(entry.message, State):
            states.append(entry.message)
        else:
            telemetry.append(entry.message)
    try:
        return dataset_from_messages(states, telemetry, car, step_s, runs, settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
