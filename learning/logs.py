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
from bayesrace.log import LogReader, topic_of
from bayesrace.messages import STATE, TELEMETRY, TRUTH, CarSample, Telemetry, car_key
from bayesrace.vehicles import CarParameters, described_car
from learning.dataset import Dataset, filter_dataset, tolerances

__all__ = ["LogFacts", "dataset_from_log", "dataset_from_messages", "fallback_cycles", "log_facts"]


@dataclass(frozen=True)
class LogFacts:
    """What a log says about itself."""

    names: tuple[str, ...]
    """Cars in the network whose states it holds, by the keys."""
    truth: bool
    """It holds what was true besides what was measured."""
    car: CarParameters | None
    """The car that drove, by who recorded it; None if that is not told."""
    discretisation: Discretisation | None
    """With which its controller predicted; None if that is not told."""


def log_facts(path: str | os.PathLike[str]) -> LogFacts:
    """Reads what there is about the car; InputError if it is no log or its metadata are damaged."""
    reader = LogReader(Path(path))
    keys = [(topic_of(key), key.split("/")[1]) for key in reader.channels()]
    names = sorted(name for topic, name in keys if topic is STATE)
    truth = any(topic is TRUTH for topic, _ in keys)
    metadata = reader.metadata()
    told: dict[str, Any] = dict(metadata.get("collect") or metadata.get("drive") or {})
    try:
        if "race" in metadata:
            told = json.loads(metadata["race"].get("settings", "{}"))
        given = told.get("discretisation")
        discretisation = None if given is None else Discretisation.model_validate(given)
        car = described_car(told["car"]) if told.get("car") else None
        return LogFacts(tuple(names), truth, car, discretisation)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (ValueError, AttributeError, ValidationError) as error:
        raise InputError(f"{path}: its settings cannot be read ({error})") from error


def fallback_cycles(telemetry: Iterable[Telemetry]) -> set[tuple[int, int]]:
    """Run and number of the states that the fallback has answered."""
    return {(message.run, message.state_seq) for message in telemetry if message.fallback > 0}


def dataset_from_messages(
    states: Iterable[CarSample],
    fallback: Collection[tuple[int, int]],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
) -> Dataset:
    """Filtered samples from consecutive states of the same run (all runs, or those named).

    ``states``: as measured, to learn from; the truth, to judge what was learned. ``fallback``: run
    and number of the states whose cycles are left out, :func:`fallback_cycles`. The input of sample
    k is ``u_applied`` of the state after it: what acted, not what was asked. A missing state ends
    the stretch ("gap").
    """
    slack_s = tolerances(car)["time"].value
    wanted = [state for state in states if runs is None or state.run in runs]
    x, u, x_next, driven = [], [], [], []
    gaps = 0
    for now, after in itertools.pairwise(wanted):
        if now.run != after.run or after.time_s == now.time_s:
            continue  # a fault of the plant repeats the last state: no time has passed
        if after.seq != now.seq + 1 or abs(after.time_s - now.time_s - step_s) > slack_s:
            gaps += 1
            continue
        x.append(now.x)
        u.append(after.u_applied)
        x_next.append(after.x)
        driven.append((now.run, now.seq) not in fallback)
    if not x:
        pairs = [(a, b) for a, b in itertools.pairwise(wanted) if a.run == b.run]
        steps = [b.time_s - a.time_s for a, b in pairs if b.seq == a.seq + 1]
        if not steps:
            raise InputError(
                "no two states follow one another; was the car driven, or does the network or the "
                "machine lose messages? Give them less to do"
            )
        raise InputError(
            f"states are {float(np.median(steps)):.3g} s apart, the model's step is {step_s:g} s; "
            f"drive with --rate {1 / step_s:g}, or learn for the controller that drove: --artefact"
        )
    dropped = {"gap": gaps} if gaps else {}
    samples = Dataset(car, step_s, np.array(x), np.array(u), np.array(x_next), dropped)
    return filter_dataset(samples.select(np.array(driven), "fallback"))


def dataset_from_log(
    path: str | os.PathLike[str],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    name: str = "",
    truth: bool = False,
) -> Dataset:
    """Filtered samples of ``car`` from a run's MCAP log; see :func:`dataset_from_messages`.

    ``name``: its name in the network, if that is another one than its own. ``truth``: what was true
    in place of what was measured. InputError if it is no log or holds no driving of this car.
    """
    reader = LogReader(Path(path))
    topics = TRUTH if truth else STATE, TELEMETRY
    keys = {car_key(topic.key, name or car.name) for topic in topics}
    states: list[CarSample] = []
    fallback: set[tuple[int, int]] = set()
    for entry in reader.messages(topics):
        if entry.key not in keys:
            continue
        if isinstance(entry.message, CarSample):
            states.append(entry.message)
        else:
            fallback |= fallback_cycles([entry.message])
    try:
        return dataset_from_messages(states, fallback, car, step_s, runs)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
