"""One dataset from any number of logs and array files, all of the same car and discretisation."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.vehicles import CarParameters, builtin_cars
from learning.arrays import car_of_npz, dataset_from_npz
from learning.dataset import Dataset, concatenate, filter_dataset
from learning.logs import LogFacts, dataset_from_log, log_facts

__all__ = ["Samples", "read_samples"]

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Samples:
    """Filtered samples, and the discretisation that the residual is to be made with."""

    dataset: Dataset
    discretisation: Discretisation


def read_samples(
    paths: Sequence[Path],
    car: CarParameters | None = None,
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
    cars = {
        path: logs[path].car or builtin_cars().get(drivers[path])
        if path in logs
        else car_of_npz(path)
        for path in paths
    }
    driven = _common("cars", cars | {Path("--car"): car}, lambda one: f"'{one.identity}'")
    if driven is None:
        raise InputError("no file names its car; name it with --car")
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
            samples = filter_dataset(dataset_from_npz(path, driven, used.step_s), limits=limits)
        digest = samples.digest()
        if digest in seen and len(samples):
            raise InputError(f"{path} holds the same samples as {seen[digest]}; give them once")
        seen[digest] = path
        datasets.append(samples)
    return Samples(concatenate(datasets), used)


def _driver(path: Path, facts: LogFacts, name: str) -> str:
    """The name in the network of the car whose messages are read from a log."""
    names = [one for one in facts.names if not name or one == name]
    if len(names) > 1:
        raise InputError(f"{path} holds several cars ({', '.join(names)}); choose one with --name")
    if not names:
        which = f"car '{name}'" if name else "any car"
        raise InputError(f"{path} holds no states of {which}; give the log of a drive")
    return names[0]


def _common(what: str, named: Mapping[Path, T | None], text: Callable[[T], str]) -> T | None:
    """The first named value, None if there is none; InputError if others differ by ``text``."""
    sources = {path: value for path, value in named.items() if value is not None}
    if len({text(value) for value in sources.values()}) > 1:
        listed = "; ".join(f"{text(value)} ({path})" for path, value in sources.items())
        raise InputError(f"different {what} cannot be mixed: {listed}; give logs of one kind")
    return next(iter(sources.values()), None)


def _described(one: Discretisation) -> str:
    return f"{one.scheme}x{one.substeps}, {one.pose} pose, {one.step_s!r} s"
