"""Datasets from run logs and from logged messages."""

import itertools
import json
import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.integrators import Discretisation
from bayesrace.log import LogReader, topic_of
from bayesrace.messages import STATE, TELEMETRY, TRUTH, CarSample, Telemetry, car_key
from bayesrace.vehicles import CarParameters, described_car
from learning.dataset import Dataset, filter_dataset, tolerances

__all__ = [
    "LogFacts",
    "cycles_left_out",
    "dataset_from_log",
    "dataset_from_messages",
    "fallback_cycles",
    "log_facts",
]


_DOUBTFUL: Final = 16
"""States up to one that is not believed which may be wrong as well: the controller looks back as
far (controller/native/br_monitor.c)."""


@dataclass(frozen=True)
class LogFacts:
    """Keys and metadata of a log, as far as they concern the car."""

    names: tuple[str, ...]
    """Names in the network of the cars whose states it holds."""
    true: frozenset[str]
    """Names of the cars whose true states it holds besides the measured ones."""
    car: CarParameters | None
    """The recorded car; None if the log does not name it."""
    discretisation: Discretisation | None
    """The one that its controller predicted with; None if the log does not name it."""


def log_facts(path: str | os.PathLike[str]) -> LogFacts:
    """Reads keys and metadata; InputError if it is no log or its metadata are damaged."""
    reader = LogReader(Path(path))
    keys = [(topic_of(key), key.split("/")[1]) for key in reader.channels()]
    metadata = reader.metadata()
    settings: dict[str, Any] = dict(metadata.get("collect") or metadata.get("drive") or {})
    try:
        for program in ("race", "latency"):
            if program in metadata:
                settings = json.loads(metadata[program].get("settings", "{}"))
        if settings.get("attach"):
            settings = {}  # those of the program that has attached itself, not of the car
        given = settings.get("discretisation")
        return LogFacts(
            names=tuple(sorted(name for topic, name in keys if topic is STATE)),
            true=frozenset(name for topic, name in keys if topic is TRUTH),
            car=described_car(settings["car"]) if settings.get("car") else None,
            discretisation=None if given is None else Discretisation.model_validate(given),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: discretisation in its settings: {faults_in(error)}") from None
    except (ValueError, AttributeError) as error:
        raise InputError(f"{path}: its settings cannot be read ({error})") from error


def fallback_cycles(telemetry: Iterable[Telemetry]) -> set[tuple[int, int]]:
    """Run and number of the states in whose cycles the fallback acted, or that were not believed;
    those just before such a state may be as wrong."""
    cycles = ((one.run, one.state_seq, one.fallback, one.sensor_fault) for one in telemetry)
    return cycles_left_out(cycles)


def cycles_left_out(cycles: Iterable[tuple[int, int, int, object]]) -> set[tuple[int, int]]:
    """The same by run, number of the state, level of the fallback, and what speaks against the
    state, if anything."""
    found: set[tuple[int, int]] = set()
    for run, seq, level, fault in cycles:
        if fault:
            found |= {(run, seq - n) for n in range(_DOUBTFUL)}
        elif level > 0:
            found.add((run, seq))
    return found


def dataset_from_messages(
    states: Iterable[CarSample],
    fallback: Collection[tuple[int, int]],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    *,
    limits: bool = True,
) -> Dataset:
    """Filtered samples from consecutive states of the same run (all runs, or those named).

    ``states``: the measured ones to learn from, the true ones to judge by. ``fallback``: run and
    number of the states whose cycles are left out, :func:`fallback_cycles`. The input of sample k
    is ``u_applied`` of the state after it, which acted, not the requested one. A missing state is
    counted as "gap". ``limits``: as of :func:`~learning.dataset.filter_dataset`.
    """
    slack_s = tolerances(car)["time"]
    wanted = [state for state in states if runs is None or state.run in runs]
    # A fault of the plant repeats the last state: no time has passed.
    pairs = [
        (now, after)
        for now, after in itertools.pairwise(wanted)
        if now.run == after.run and after.time_s != now.time_s
    ]
    found = [
        (now, after)
        for now, after in pairs
        if after.seq == now.seq + 1 and abs(after.time_s - now.time_s - step_s) <= slack_s
    ]
    if not found:
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
    gaps = {"gap": len(pairs) - len(found)} if len(pairs) > len(found) else {}
    samples = Dataset(
        car,
        step_s,
        x=np.array([now.x for now, _ in found]),
        u=np.array([after.u_applied for _, after in found]),
        x_next=np.array([after.x for _, after in found]),
        dropped=gaps,
    )
    driven = [(now.run, now.seq) not in fallback for now, _ in found]
    return filter_dataset(samples.select(driven, "fallback"), limits=limits)


def dataset_from_log(
    path: str | os.PathLike[str],
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    name: str = "",
    truth: bool = False,
    *,
    limits: bool = True,
) -> Dataset:
    """Filtered samples of ``car`` from a run's MCAP log; see :func:`dataset_from_messages`.

    ``name``: the car's name in the network, if it differs from its own. ``truth``: the true states
    in place of the measured ones. InputError if it is no log or holds no driving of this car.
    """
    topics = TRUTH if truth else STATE, TELEMETRY
    keys = {car_key(topic.key, name or car.name) for topic in topics}
    states: list[CarSample] = []
    fallback: set[tuple[int, int]] = set()
    for entry in LogReader(Path(path)).messages(topics):
        if entry.key not in keys:
            continue
        if isinstance(entry.message, CarSample):
            states.append(entry.message)
        else:
            fallback |= fallback_cycles([entry.message])
    try:
        return dataset_from_messages(states, fallback, car, step_s, runs, limits=limits)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
