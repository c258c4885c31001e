"""One dataset from any number of logs and array files, all of the same car and discretisation.

A file of arrays (``.npz``, made by ``numpy.savez``; reading executes nothing) holds ``car`` (a
built-in name, or all values as JSON), ``step_s`` [s], and either single samples, ``x`` (n, 7),
``u`` (n, 2), ``x_next`` (n, 7), or one unbroken drive, ``states`` (n + 1, 7), ``inputs`` (n, 2), as
:class:`bayesrace.learning.dataset.Dataset` describes them. Single samples that are estimated have
their ``deviation`` (n, 4) (:class:`bayesrace.learning.drives.Estimates`). Any other array is
refused: it may be a misspelt one.

The published form, the drives of the paper's code, is read as well: ``states`` (6 or 7, n + 1),
their rates ``dstates``, ``inputs`` (2, n) with duty cycle and **steering angle**, any other arrays,
but no ``car``. Without ``dstates`` the published states are one-step predictions of a model, each
from a state of another file, and are refused. The published plant holds inputs[1, k] during the
whole step k, while our cars turn the steering at a constant rate, from delta_k to delta_k + step *
delta_rate. Both agree on the angle at the end of a step, so

    delta_k = inputs[1, k - 1]  (0 at the start),    delta_rate_k = (inputs[1, k] - delta_k) / step

which the published seventh state and one-step predictions use, too. The residual of such a drive
contains the difference between a held and a turning steering angle: fine for comparing with the
paper, wrong for driving our cars. Nor does that drive keep to the limits of the car.
"""

import json
import os
import zipfile
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import ValidationError

from bayesrace.arrays import AnyArray, Flags
from bayesrace.columns import Columns, LogColumns
from bayesrace.errors import InputError, faults_in
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.dataset import (
    Dataset,
    concatenate,
    consecutive,
    dataset_from_arrays,
    filter_dataset,
)  # fmt: skip
from bayesrace.learning.drives import Estimates
from bayesrace.log import LogReader
from bayesrace.messages import STATE, TELEMETRY, TRUTH, topic_of
from bayesrace.vehicles import Car, builtin_cars, car_text, described_car

__all__ = ["CYCLES", "MAX_BYTES", "STATES", "TRUE_STATES", "LogFacts", "Samples"]
__all__ += ["dataset_from_columns", "dataset_from_log", "dataset_from_npz", "log_facts"]
__all__ += ["read_samples", "recorded_car", "write_npz"]

T = TypeVar("T")
TRUE_STATES: Final = "seq run time_s x u_applied"
"""Columns of the true states that samples can be made of, ..."""
STATES: Final = f"{TRUE_STATES} estimated readings"
"""... of those that a controller sees ..."""
CYCLES: Final = "run state_seq fallback sensor_fault estimate deviation"
"""... and of the telemetry, which says what is left out of them, and what was estimated."""

_DOUBTFUL: Final = 16
"""States up to one that is not believed which may be wrong as well: the controller looks back as
far (controller/native/br_state.c)."""

MAX_BYTES: Final = 1 << 30
"""Upper limit of an array file's unpacked size; larger ones are refused before they are read."""

_ABOUT: Final = ("car", "step_s")
_SAMPLES: Final = ("x", "u", "x_next")
_DRIVE: Final = ("states", "inputs")
_SCHEMA: Final = (
    "need 'car', 'step_s', and either 'x' (n, 7), 'u' (n, 2), 'x_next' (n, 7), with 'deviation' "
    "(n, 4) if states are estimated, or 'states' (n + 1, 7), 'inputs' (n, 2)"
)


# Logs --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LogFacts:
    """Keys and metadata of a log, as far as they concern the car."""

    names: tuple[str, ...]
    """Names in the network of the cars whose states it holds."""
    true: frozenset[str]
    """Names of the cars whose true states it holds besides the measured ones."""
    car: Car | None
    """The recorded car; None if the log does not name it."""
    discretisation: Discretisation | None
    """The one that its controller predicted with; None if the log does not name it."""
    track: str = ""
    """Name of the track that was driven; empty if the log does not name it."""


def log_facts(path: str | os.PathLike[str]) -> LogFacts:
    """Reads keys and metadata; InputError if it is no log or its metadata are damaged."""
    channels, metadata = LogReader(Path(path)).contents()
    keys = [(topic_of(key), key.split("/")[1]) for key in channels]
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
            track=str(settings.get("track") or ""),
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
    car: Car,
    step_s: float,
    runs: Collection[int] | None = None,
    *,
    limits: bool = True,
) -> Dataset:
    """Filtered samples from consecutive states of the same run (all runs, or those named).

    ``states`` has the columns :data:`STATES` to learn from, or those of the true ones to judge by.
    ``cycles`` has the columns :data:`CYCLES`. Left out are the states in whose cycles the
    fallback acted, and those that were not believed, with the states just before, which may be as
    wrong; but not those that the controller was uncertain of, because smoothing says how uncertain
    they are. The input of sample k is ``u_applied`` of the state after it, which acted, not the
    requested one. States that are to be estimated are smoothed (:mod:`~.smoothing`), and those that
    nothing was read for are left out. A missing state is counted as "gap". ``limits``: as of
    :func:`~bayesrace.learning.dataset.filter_dataset`.
    """
    if runs is not None:
        states = states[np.isin(states["run"], list(runs))]
    estimates: Estimates | None = None
    lost: Counter[str] = Counter()
    if "estimated" in (states.dtype.names or ()) and states["estimated"].any():
        # CasADi and more, which a program that reads measured states does not need.
        from bayesrace.learning.estimates import smoothed_states

        states, estimates, lost = smoothed_states(states, cycles, car, step_s)
    now, after = states[:-1], states[1:]
    passed_s = after["time_s"] - now["time_s"]
    # A fault of the plant repeats the last state: no time has passed.
    pair = (now["run"] == after["run"]) & (passed_s != 0)
    following = pair & (after["seq"] == now["seq"] + 1)
    found = consecutive(states, step_s)
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
    if gaps := int(pair.sum() - found.sum()):
        lost["gap"] = gaps
    estimates = estimates and estimates.select(np.flatnonzero(found))
    now, after = now[found], after[found]
    moved = now["x"], after["u_applied"], after["x"]
    samples = Dataset(car, step_s, *moved, dropped=lost, estimates=estimates)
    return filter_dataset(samples.select(~_left_out(now, cycles), "fallback"), limits=limits)


def _left_out(states: Columns, cycles: Columns) -> Flags:
    """Which of the states are not driven by a solution, or not to be believed."""
    fallback = cycles[cycles["fallback"] > 0]
    doubted = cycles[~np.isin(cycles["sensor_fault"], ("", "uncertain"))]
    keys = {(run, seq) for run, seq in fallback[["run", "state_seq"]].tolist()}
    for run, seq in doubted[["run", "state_seq"]].tolist():
        keys |= {(run, seq - n) for n in range(_DOUBTFUL)}
    return np.array([key in keys for key in states[["run", "seq"]].tolist()], dtype=bool)


def dataset_from_log(
    path: str | os.PathLike[str],
    car: Car,
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
    topic, names = (TRUTH, TRUE_STATES) if truth else (STATE, STATES)
    log = LogColumns(Path(path), {topic: names, TELEMETRY: CYCLES}, name or car.name).read()
    try:
        return dataset_from_columns(log[topic], log[TELEMETRY], car, step_s, runs, limits=limits)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


# Arrays ------------------------------------------------------------------------------------------


def dataset_from_npz(path: Path, car: Car | None = None, step_s: float | None = None) -> Dataset:
    """All samples of a file, unfiltered.

    ``car`` and ``step_s``: the expected ones, if given; the published form, which names neither,
    needs both. InputError for any other content than the arrays above, pickled ones included.
    """
    return _read(path).dataset(car, step_s)


def write_npz(path: Path, dataset: Dataset) -> None:
    """The samples as :func:`dataset_from_npz` reads them."""
    car, step_s = np.array(car_text(dataset.car)), np.array(dataset.step_s)
    arrays: dict[str, Any] = {"x": dataset.x, "u": dataset.u, "x_next": dataset.x_next}
    if dataset.estimates is not None:
        arrays["deviation"] = dataset.deviation
    np.savez_compressed(path, car=car, step_s=step_s, **arrays)


def _read(path: Path) -> "_File":
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise InputError(f"more than {MAX_BYTES >> 20} MB; split it")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
        car = arrays.get("car")
        if car is not None and (car.shape != () or car.dtype.kind != "U"):
            raise InputError("'car' must be one text")
        return _File(path, arrays, None if car is None else described_car(str(car)))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # damage raises anything of zipfile, zlib, lzma or numpy
        raise InputError(f"{path}: not arrays as numpy.savez writes them ({error})") from error


@dataclass(frozen=True)
class _File:
    """Arrays by name, and the car that they describe, if any."""

    path: Path
    arrays: Mapping[str, AnyArray]
    car: Car | None

    def dataset(self, car: Car | None, step_s: float | None) -> Dataset:
        """The samples; InputError unless they are of this car and step."""
        try:
            dataset = self._published(car, step_s) if self._is_published() else self._own()
            if car is not None and dataset.car != car:
                raise InputError(f"samples of the car '{dataset.car.name}', not of '{car.name}'")
            if step_s is not None and abs(dataset.step_s - step_s) > 1e-9:
                raise InputError(f"samples {dataset.step_s:g} s apart, not {step_s:g} s")
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from error
        # A step in single precision becomes the number that is meant: samples can be mixed.
        return dataset if step_s is None else replace(dataset, step_s=step_s)

    def _numbers(self, *names: str) -> list[AnyArray]:
        for name in names:
            if self.arrays[name].dtype.kind not in "fiu":
                raise InputError(f"'{name}' holds no numbers")
        return [self.arrays[name] for name in names]

    def _own(self) -> Dataset:
        names = set(self.arrays)
        forms = [{*_ABOUT, *one} for one in (_SAMPLES, (*_SAMPLES, "deviation"), _DRIVE)]
        if self.car is None or names not in forms:
            raise InputError(f"arrays {', '.join(sorted(names)) or 'none'}; {_SCHEMA}")
        (step_s,) = self._numbers("step_s")
        if step_s.shape != () or not 0 < step_s <= 1:
            raise InputError("'step_s' must be one number of seconds, above 0 and at most 1")
        if "states" in names:
            return dataset_from_arrays(self.car, float(step_s), *self._numbers(*_DRIVE))
        known = Estimates.settled(*self._numbers("deviation")) if "deviation" in names else None
        return Dataset(self.car, float(step_s), *self._numbers(*_SAMPLES), estimates=known)

    def _is_published(self) -> bool:
        if not self.arrays.keys() >= {*_DRIVE} or self.arrays.keys() & {*_ABOUT}:
            return False
        states, inputs = self.arrays["states"].shape, self.arrays["inputs"].shape
        return len(states) == 2 and states[0] in (6, 7) and inputs == (2, states[1] - 1)

    def _published(self, car: Car | None, step_s: float | None) -> Dataset:
        """All samples of a published drive; zero columns that pad its end are left out."""
        if "dstates" not in self.arrays:
            raise InputError(
                "no 'dstates', so these are predictions of a model (the published KIN-*.npz) and "
                "not a drive: give the drive (DYN-*.npz)"
            )
        if car is None or step_s is None:
            raise InputError("the published form does not name its car and step; give both")
        states, inputs = self._numbers(*_DRIVE)
        used = np.flatnonzero(states.any(axis=0))
        if len(used) < 2:
            raise InputError("fewer than two states that are not zero")
        end = int(used[-1]) + 1
        delta = np.concatenate(([0.0], inputs[1, : end - 1]))
        x = np.vstack((states[:6, :end], delta)).T
        u = np.column_stack((inputs[0, : end - 1], np.diff(delta) / step_s))
        return dataset_from_arrays(car, step_s, x, u)


# Mixtures ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Samples:
    """Filtered samples, and the discretisation that the residual is to be made with."""

    dataset: Dataset
    discretisation: Discretisation


def read_samples(
    paths: Sequence[Path],
    car: Car | None = None,
    name: str = "",
    discretisation: Discretisation | None = None,
    runs: Collection[int] | None = None,
    truth: bool = False,
    *,
    limits: bool = True,
) -> Samples:
    """All samples of logs (MCAP) and arrays (``.npz``), filtered, in the order given.

    ``car``: the driven one, where the files do not name it; ``name``: its name in the network,
    where a log holds several; ``discretisation``: for the residual, by default the one that the
    logs name, or ``PREDICTION``; ``runs``: the wanted runs of the logs, by default all; ``truth``:
    the true states in place of the measured ones, of the logs that hold them; ``limits``: leave out
    samples outside the car's limits. InputError if cars, discretisations or steps differ, or if two
    files hold the same samples.
    """
    if not paths:
        raise InputError("no samples given; name at least one log, or --data FILE.npz")
    logs = {path: log_facts(path) for path in paths if path.suffix.lower() != ".npz"}
    drivers = {path: _driver(path, facts, name) for path, facts in logs.items()}
    files = {path: _read(path) for path in paths if path not in logs}
    cars = _cars(logs, drivers) | {path: file.car for path, file in files.items()}
    driven = _the_car(cars | {Path("--car"): car})
    named = {path: facts.discretisation for path, facts in logs.items()}
    used = _common("discretisations", named | {Path("as asked for"): discretisation}, _described)
    used = used or PREDICTION
    datasets: list[Dataset] = []
    seen: dict[str, Path] = {}
    for path in paths:
        if path in logs:
            true = truth and drivers[path] in logs[path].true
            samples = dataset_from_log(
                path, driven, used.step_s, runs, drivers[path], true, limits=limits
            )
        else:
            samples = filter_dataset(files[path].dataset(driven, used.step_s), limits=limits)
        digest = samples.digest()
        if digest in seen and len(samples):
            raise InputError(f"{path} holds the same samples as {seen[digest]}; give them once")
        seen[digest] = path
        datasets.append(samples)
    return Samples(concatenate(datasets), used)


def recorded_car(
    paths: Sequence[Path], given: Car | None, name: str
) -> tuple[Car, dict[Path, str]]:
    """The car that drove, ``given`` or as the logs name it, and its name in the network of each.

    InputError if there is none, or if a log holds no states of it.
    """
    if not paths:
        raise InputError("no log given; name the log of a drive, as 'bayesrace collect' writes it")
    logs = {path: log_facts(path) for path in paths}
    wanted = name or (given.name if given else "")
    drivers = {path: _driver(path, facts, wanted) for path, facts in logs.items()}
    return given or _the_car(_cars(logs, drivers)), drivers


def _driver(path: Path, facts: LogFacts, name: str) -> str:
    """The name in the network of the car whose messages are read from a log."""
    names = [one for one in facts.names if not name or one == name]
    if len(names) > 1:
        raise InputError(f"{path} holds several cars ({', '.join(names)}); choose one with --name")
    if not names:
        found = ", ".join(facts.names) or "no car"
        raise InputError(
            f"{path} holds states of {found}"
            + (f", not of '{name}': give the car that drove with --car, or its name in the network "
               "with --name" if facts.names else "; give the log of a drive, or make one of what "
               "others have recorded with 'bayesrace import-drive'")
        )  # fmt: skip
    return names[0]


def _cars(logs: Mapping[Path, LogFacts], drivers: Mapping[Path, str]) -> dict[Path, Car | None]:
    """The car of each log, recorded or built in."""
    return {path: facts.car or builtin_cars().get(drivers[path]) for path, facts in logs.items()}


def _the_car(cars: Mapping[Path, Car | None]) -> Car:
    """The only one; InputError if there are several, or none."""
    car = _common("cars", cars, lambda one: f"'{one.identity}'")
    if car is None:
        raise InputError("no file names its car; name it with --car")
    return car


def _common(what: str, named: Mapping[Path, T | None], text: Callable[[T], str]) -> T | None:
    """The first named value, None if there is none; InputError if others differ by ``text``."""
    sources = {path: value for path, value in named.items() if value is not None}
    if len({text(value) for value in sources.values()}) > 1:
        listed = "; ".join(f"{text(value)} ({path})" for path, value in sources.items())
        raise InputError(f"different {what} cannot be mixed: {listed}; give logs of one kind")
    return next(iter(sources.values()), None)


def _described(one: Discretisation) -> str:
    return f"{one.scheme}x{one.substeps}, {one.pose} pose, {one.step_s!r} s"
