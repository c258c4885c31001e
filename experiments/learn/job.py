"""``bayesrace learn`` from its settings to its folder."""

from collections.abc import Callable, Sequence
from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.manifest import read_manifest
from bayesrace.tracks import load_track
from bayesrace.transport import Endpoints, open_session
from bayesrace.vehicles import CarParameters
from experiments.learn.figure import References, draw, references
from experiments.learn.journal import Journal, Record
from experiments.learn.loop import Learner
from experiments.learn.settings import LearnSettings
from learning.dataset import Dataset
from learning.residual import discretisation_of
from learning.sources import read_samples

__all__ = ["discretisation_from", "learn"]


def discretisation_from(
    car: CarParameters, weights: Path | None, artefact: Path | None, points: int, folder: Path
) -> Discretisation:
    """What the controller predicts with, by its artefact or by weights for it; else the default.

    In a folder that is gone on with, what it was learned for takes the place of weights and
    default. InputError if artefact and weights contradict each other, or the points do not fit.
    """
    told: dict[Discretisation, str] = {}
    default = PREDICTION
    if Journal.resumable(folder):
        weights, default = None, Journal.settings_in(folder).discretisation
    if artefact is not None:
        manifest = read_manifest(artefact)
        manifest.check_points(points)
        told[discretisation_of(manifest.discretisation, car)] = str(artefact)
    if weights is not None:
        told.setdefault(discretisation_of(read_weights(weights).discretisation, car), str(weights))
    if len(told) > 1:
        raise InputError(f"{' and '.join(told.values())} are for different discretisations")
    return next(iter(told), default)


def learn(
    settings: LearnSettings,
    endpoints: Endpoints,
    folder: Path,
    data: Sequence[Path],
    weights: Path | None,
    say: Callable[[str], None],
) -> Record:
    """Learns until the settings' number of laps, or a signal; what its folder then tells.

    ``data`` and ``weights`` are to begin with: in a folder that is gone on with they are not read.
    InputError for what cannot be used; a plant or a controller that is not there is none: it is
    waited for.
    """
    width_m = settings.car.width_m
    track = None if settings.track is None else load_track(settings.track, width_m)
    beside = references(settings.compare)
    unread = []
    if Journal.resumable(folder):
        unread = [name for name, given in (("--data", data), ("--weights", weights)) if given]
        data, weights = (), None
    samples = _samples(settings, data)  # what cannot be used is told before there is a folder
    given = None if weights is None else _weights(settings, weights)
    with Journal(folder, settings) as journal:
        with open_session(endpoints) as session:
            learner = Learner(
                session, settings, journal, track, say, lambda: _draw(journal, beside)
            )
            learner.begin(samples, given, unread)
            learner.run()
        _draw(journal, beside)
        return journal.record


def _draw(journal: Journal, beside: References) -> None:
    draw(journal.record, beside, journal.path(Journal.FILES.plot))


def _samples(settings: LearnSettings, data: Sequence[Path]) -> Dataset | None:
    if not data:
        return None
    found = read_samples(data, settings.car, "", settings.discretisation)
    return found.dataset


def _weights(settings: LearnSettings, path: Path) -> GpWeights:
    weights = read_weights(path)
    if weights.car != settings.car.name:
        raise InputError(f"{path} is for the car '{weights.car}', not '{settings.car.name}'")
    return weights
