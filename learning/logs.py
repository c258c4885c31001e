"""Datasets from run logs and from logged messages."""

import itertools
import json
import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bayesrace.errors import InputError
from bayesrace.integrators import Discretisation
from bayesrace.log import LogReader
from bayesrace.messages import STATE, TELEMETRY, State, Telemetry, car_key
from bayesrace.vehicles import CarParameters, described_car
from learning.dataset import Dataset, FilterSettings, filter_dataset

__all__ = ["LogFacts", "dataset_from_log", "dataset_from_messages", "log_facts"]


@dataclass(frozen=True)
class LogFacts:
    """What a log says about itself."""

    names: tuple[str, ...]
    """Cars in the network whose states it holds, by the keys."""
    car: CarParameters | None
    """The car that drove, by who recorded it; None if that is not told."""
    discretisation: Discretisation | None
    """With which its controller predicted; None if that is not told."""


def log_facts(path: str | os.PathLike[str]) -> LogFacts:
    """Reads what there is about the car; InputError if it is no log or its metadata are damaged."""
    reader = LogReader(Path(path))
    names = {entry.key.split("/")[1]: None for entry in reader.messages((STATE,))}
    metadata = reader.metadata()
    told: dict[str, Any] = dict(metadata.get("collect") or metadata.get("drive") or {})
    try:
        if "race" in metadata:
            told = json.loads(metadata["race"].get("settings", "{}"))
        given = told.get("discretisation")
        discretisation = None if given is None else Discretisation.model_validate(given)
        car = described_car(told["car"]) if told.get("car") else None
        return LogFacts(tuple(names), car, discretisation)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (ValueError, AttributeError, ValidationError) as error:
        raise InputError(f"{path}: its settings cannot be read ({error})") from error


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
        steps = [b.time_s - a.time_s for a, b in itertools.pairwise(wanted) if a.run == b.run]
        if not steps:
            raise InputError("the log has no two consecutive states; was the car driven?")
        raise InputError(
            f"no two states are {step_s:g} s apart, but {float(np.median(steps)):g} s; learn with "
            "the step that was driven with"
        )
    dropped = {"gap": gaps} if gaps else {}
    samples = Dataset(car, step_s, np.array(x), np.array(u), np.array(x_next), dropped)
    return filter_dataset(samples.select(np.array(driven), "fallback"), settings)


def dataset_from_log(
    path: str | os.PathLike[str],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    settings: FilterSettings | None = None,
    name: str = "",
) -> Dataset:
    """Filtered samples of ``car`` from a run's MCAP log; see :func:`dataset_from_messages`.

    ``name``: its name in the network, if that is another one than its own. InputError if it is no
    log or holds no driving of this car.
    """
    reader = LogReader(Path(path))
    keys = {car_key(topic.key, name or car.name) for topic in (STATE, TELEMETRY)}
    states: list[State] = []
    telemetry: list[Telemetry] = []
    for entry in reader.messages((STATE, TELEMETRY)):
        if entry.key not in keys:
            continue
        if isinstance(entry.message, State):
            states.append(entry.message)
        elif entry.message.fallback > 0:  # others say nothing here, and each carries a plan
            telemetry.append(entry.message)
    try:
        return dataset_from_messages(states, telemetry, car, step_s, runs, settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
