"""Driven samples that need no track: smooth random inputs, as arrays, messages and log files."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.columns import columns_of
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import Dataset, dataset_from_arrays
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.log import LogWriter
from bayesrace.messages import Message, State, Telemetry, Truth, encode
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import Model

__all__ = ["CAR", "QUICK", "STEP_S", "blank", "dataset_of", "drive", "logged", "state"]
__all__ += ["telemetry", "write_log"]

M = TypeVar("M", bound=Message)

CAR = get_car("orca")
STEP_S = PREDICTION.step_s
QUICK = TrainingSettings(kernels=("rbf",), restarts=0, hyper_points=100, iterations=25)


def drive(model: Model, count: int, seed: int, substeps: int = 10, vx: float = 1.5) -> Dataset:
    """Random smooth inputs within the limits, one unbroken drive."""
    random = np.random.default_rng(seed)
    step = Discretisation(scheme="rk4", step_s=STEP_S, substeps=substeps).discretise(model)
    phase = random.uniform(0, 2 * np.pi, 3)
    x = [np.array([0, 0, 0, vx, 0, 0, 0.0])]
    u = []
    for k in range(count):
        target = 0.25 * np.sin(0.13 * k + phase[0]) + 0.05 * np.sin(0.71 * k + phase[1])
        rate = np.clip((target - x[-1][6]) / STEP_S, -5, 5)
        duty = np.clip(0.35 + 0.3 * np.sin(0.05 * k + phase[2]), -0.1, 1)
        u.append([duty, rate])
        x.append(np.array(step(x[-1], u[-1]))[:, 0])
    return dataset_from_arrays(CAR, STEP_S, np.array(x), np.array(u))


def blank(kind: type[M], /, **known: Any) -> M:
    """A message of this kind; fields that are not ``known`` are zero or empty."""
    kinds = get_type_hints(kind)
    names = set(kind.__struct_fields__) - set(known)
    empty = {name: {} if get_origin(kinds[name]) is Mapping else kinds[name]() for name in names}
    return kind(**known, **empty)


def state(run: int, seq: int, x: Floats, u: Floats, **known: Any) -> State:
    time_s = round(seq * STEP_S, 9)
    car: dict[str, Any] = {"time_s": time_s, "x": tuple(x), "u_applied": tuple(u), "lockstep": True}
    return blank(State, **({"seq": seq, "epoch": 1, "run": run} | car | known))


def telemetry(run: int, state_seq: int, fallback: int, **known: Any) -> Telemetry:
    return blank(Telemetry, seq=state_seq, run=run, state_seq=state_seq, fallback=fallback, **known)


def logged(data: Dataset, run: int) -> list[State]:
    """The states a plant would publish: each names the input of the period before."""
    x = np.vstack((data.x, data.x_next[-1:]))
    u = np.vstack((np.zeros(2), data.u))
    return [state(run, k, x[k], u[k]) for k in range(len(x))]


def dataset_of(
    states: Sequence[State], cycles: Sequence[Telemetry] = (), runs: Collection[int] | None = None
) -> Dataset:
    """What is learned from the states that a controller answered in these cycles."""
    columns = columns_of(State, states, STATES), columns_of(Telemetry, cycles, CYCLES)
    return dataset_from_columns(*columns, CAR, STEP_S, runs)


def write_log(
    path: Path,
    data: Dataset,
    name: str = "orca",
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    truth: Dataset | None = None,
) -> Path:
    """A log of one unbroken drive, as a plant's states and, if it is given, their truth."""
    log = LogWriter(path, metadata)
    for one in logged(data, 0):
        log.write(f"bayesrace/{name}/state", encode(one), 1 + one.seq)
    for one in [] if truth is None else logged(truth, 0):
        sample = Truth(**{name: getattr(one, name) for name in Truth.__struct_fields__})
        log.write(f"bayesrace/{name}/truth", encode(sample), 1 + one.seq)
    log.close()
    return path
