"""Datasets from run logs and from logged messages."""

import json
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bayesrace.arrays import Flags
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError, faults_in
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import ROUNDING, Dataset, filter_dataset
from bayesrace.log import LogReader, topic_of
from bayesrace.messages import STATE, TELEMETRY, TRUTH
from bayesrace.vehicles import CarParameters, described_car

__all__ = ["CYCLES", "STATES", "LogFacts", "dataset_from_columns", "dataset_from_log", "log_facts"]

STATES: Final = "seq run time_s x u_applied"
"""Columns of the states that samples are made of ..."""
CYCLES: Final = "run state_seq fallback sensor_fault"
"""... and of the telemetry, which says what is left out of them."""

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


def dataset_from_columns(
    states: Columns,
    cycles: Columns,
    car: CarParameters,
    step_s: float,
    runs: Collection[int] | None = None,
    *,
    limits: bool = True,
) -> Dataset:
    """Filtered samples from consecutive states of the same run (all runs, or those named).

    ``states`` has the columns :data:`STATES`: the measured ones to learn from, the true ones to
    judge by. ``cycles`` has the columns :data:`CYCLES`. Left out are the states in whose cycles the
    fallback acted, and those that were not believed, with the states just before, which may be as
    wrong. The input of sample k is ``u_applied`` of the state after it, which acted, not the
    requested one. A missing state is counted as "gap". ``limits``: as of
    :func:`~bayesrace.learning.dataset.filter_dataset`.
    """
    if runs is not None:
        states = states[np.isin(states["run"], list(runs))]
    now, after = states[:-1], states[1:]
    passed_s = after["time_s"] - now["time_s"]
    # A fault of the plant repeats the last state: no time has passed.
    pair = (now["run"] == after["run"]) & (passed_s != 0)
    following = pair & (after["seq"] == now["seq"] + 1)
    found = following & (np.abs(passed_s - step_s) <= ROUNDING)
    if not found.any():
        if not following.any():
            raise InputError(
                "no two states follow one another; was the car driven, or does the network or the "
                "machine lose messages? Give them less to do"
            )
        raise InputError(
            f"states are {float(np.median(passed_s[following])):.3g} s apart, the model's step is "
            f"{step_s:g} s; drive with --rate {1 / step_s:g}, or learn for the controller that "
            "drove: --artefact"
        )
    gaps = int(pair.sum() - found.sum())
    now, after = now[found], after[found]
    samples = Dataset(
        car, step_s, now["x"], after["u_applied"], after["x"], dropped={"gap": gaps} if gaps else {}
    )
    return filter_dataset(samples.select(~_left_out(now, cycles), "fallback"), limits=limits)


def _left_out(states: Columns, cycles: Columns) -> Flags:
    """Which of the states are not driven by a solution, or not to be believed."""
    fallback, doubted = cycles[cycles["fallback"] > 0], cycles[cycles["sensor_fault"] != ""]
    keys = {(run, seq) for run, seq in fallback[["run", "state_seq"]].tolist()}
    for run, seq in doubted[["run", "state_seq"]].tolist():
        keys |= {(run, seq - n) for n in range(_DOUBTFUL)}
    return np.array([key in keys for key in states[["run", "seq"]].tolist()], dtype=bool)


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
    """Filtered samples of ``car`` from a run's MCAP log; see :func:`dataset_from_columns`.

    ``name``: the car's name in the network, if it differs from its own. ``truth``: the true states
    in place of the measured ones. InputError if it is no log or holds no driving of this car.
    """
    topic = TRUTH if truth else STATE
    log = LogColumns(Path(path), {topic: STATES, TELEMETRY: CYCLES}, name or car.name).read()
    try:
        return dataset_from_columns(log[topic], log[TELEMETRY], car, step_s, runs, limits=limits)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
