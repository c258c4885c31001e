"""One dataset from any number of logs and array files, all of the same car and discretisation."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.vehicles import CarParameters, builtin_cars
from learning.arrays import car_of_npz, dataset_from_npz
from learning.dataset import Dataset, concatenate, filter_dataset
from learning.logs import LogFacts, dataset_from_log, log_facts

__all__ = ["Samples", "read_samples"]


@dataclass(frozen=True, eq=False)
class Samples:
    """Filtered samples, and the discretisation that the residual is to be made with."""

    dataset: Dataset
    discretisation: Discretisation


@dataclass(frozen=True)
class _Source:
    path: Path
    facts: LogFacts | None
    """None for arrays."""


def _car(sources: Sequence[_Source], wanted: CarParameters | None, name: str) -> CarParameters:
    """The one car of all sources; InputError if they tell of several, or of none."""
    told: dict[str, tuple[CarParameters, Path]] = {}
    for source in sources:
        if source.facts is None:
            car = car_of_npz(source.path)
        else:
            driver = _driver(source.path, source.facts, name)
            car = source.facts.car or builtin_cars().get(driver)
        if car is not None:
            told.setdefault(car.identity, (car, source.path))
    if wanted is not None:
        told.setdefault(wanted.identity, (wanted, Path("--car")))
    if len(told) > 1:
        cars = ", ".join(f"'{name}' ({path})" for name, (_, path) in told.items())
        raise InputError(f"different cars cannot be mixed: {cars}; give logs of one car")
    if told:
        return next(iter(told.values()))[0]
    raise InputError("no file names its car; name it with --car")


def _driver(path: Path, facts: LogFacts, name: str) -> str:
    """Whose messages are read from a log: a name in the network."""
    names = [one for one in facts.names if not name or one == name]
    if len(names) > 1:
        raise InputError(f"{path} holds several cars ({', '.join(names)}); choose one with --name")
    if not names:
        whom = f"car '{name}'" if name else "any car"
        raise InputError(f"{path} holds no states of {whom}; give the log of a drive")
    return names[0]


def _discretisation(sources: Sequence[_Source], given: Discretisation | None) -> Discretisation:
    told = {} if given is None else {given: "the one asked for"}
    for source in sources:
        if source.facts is not None and source.facts.discretisation is not None:
            told.setdefault(source.facts.discretisation, str(source.path))
    if len(told) > 1:
        raise InputError(
            "different discretisations cannot be mixed: "
            + "; ".join(
                f"{d.scheme}x{d.substeps}, {d.pose} pose, {d.step_s:g} s ({where})"
                for d, where in told.items()
            )
        )
    return next(iter(told), PREDICTION)


def read_samples(
    paths: Sequence[Path],
    car: CarParameters | None = None,
    name: str = "",
    discretisation: Discretisation | None = None,
    runs: Collection[int] | None = None,
    truth: bool = False,
) -> Samples:
    """All samples of logs (MCAP) and arrays (``.npz``), filtered, in the order given.

    ``car``: what drove, where the files do not tell; ``name``: its name in the network, where a log
    holds several; ``discretisation``: what the residual is to be made with, else what the logs
    name, else the default; ``runs``: those of the logs, all without; ``truth``: what was true in
    place of what was measured, of the logs that hold it. InputError if cars, discretisations or
    steps differ, or if two files hold the same samples.
    """
    if not paths:
        raise InputError("no samples given; name at least one log, or --data FILE.npz")
    sources = [
        _Source(path, None if path.suffix.lower() == ".npz" else log_facts(path)) for path in paths
    ]
    parameters = _car(sources, car, name)
    used = _discretisation(sources, discretisation)
    datasets: dict[str, Path] = {}
    found = []
    for source in sources:
        if source.facts is None:
            raw = dataset_from_npz(source.path, parameters, used.step_s)
            samples = filter_dataset(raw)
        else:
            driver = _driver(source.path, source.facts, name)
            true = truth and source.facts.truth
            samples = dataset_from_log(source.path, parameters, used.step_s, runs, driver, true)
        digest = samples.digest()
        if digest in datasets and len(samples):
            raise InputError(
                f"{source.path} holds the same samples as {datasets[digest]}; give them once"
            )
        datasets[digest] = source.path
        found.append(samples)
    return Samples(concatenate(found), used)
