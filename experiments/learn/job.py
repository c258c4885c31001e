"""``bayesrace learn`` from its settings to its folder."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.manifest import read_manifest
from bayesrace.tracks import load_track
from bayesrace.transport import Endpoints, open_session
from bayesrace.vehicles import CarParameters
from experiments.learn.journal import Journal, resumable_settings
from experiments.learn.loop import Learner
from experiments.learn.records import LearnSettings, Record, UpdateRecord
from experiments.learn.report import draw, references
from learning.pool import recalled
from learning.residual import discretisation_of
from learning.sources import read_samples

__all__ = ["discretisation_from", "learn"]


def discretisation_from(
    car: CarParameters, weights: Path | None, artefact: Path | None, points: int, folder: Path
) -> Discretisation:
    """The controller's, by its artefact or by weights for it; else the default.

    In a folder to resume, its own takes the place of weights and default. InputError if artefact
    and weights contradict each other, or the points do not fit.
    """
    found: dict[Discretisation, str] = {}
    before = resumable_settings(folder)
    if artefact is not None:
        manifest = read_manifest(artefact)
        manifest.check_points(points)
        found[discretisation_of(manifest.discretisation, car)] = str(artefact)
    if weights is not None and before is None:
        name = read_weights(weights).discretisation
        found.setdefault(discretisation_of(name, car), str(weights))
    if len(found) > 1:
        raise InputError(f"{' and '.join(found.values())} are for different discretisations")
    return next(iter(found), PREDICTION if before is None else before.discretisation)


def learn(
    settings: LearnSettings,
    endpoints: Endpoints,
    folder: Path,
    data: Sequence[Path],
    weights: Path | None,
    say: Callable[[str], None],
) -> Record:
    """Learns until the settings' number of laps, or a signal; returns the folder's record.

    ``data`` and ``weights`` are to begin with, and not read in a folder to resume. InputError for
    what cannot be used; a plant or a controller that is not there is waited for.
    """
    track = None if settings.track is None else load_track(settings.track, settings.car.width_m)
    beside = references(settings.compare)
    unread = [name for name, one in (("--data", data), ("--weights", weights)) if one]
    if resumable_settings(folder) is not None:
        data, weights = (), None
    # What cannot be used is reported before there is a folder.
    given = None if weights is None else read_weights(weights)
    if given is not None and given.car != settings.car.name:
        raise InputError(f"{weights} is for the car '{given.car}', not '{settings.car.name}'")
    samples = (
        read_samples(data, settings.car, "", settings.discretisation).dataset if data else None
    )
    with closing(Journal(folder, settings)) as journal:
        if journal.resumed:
            why = f"; {' and '.join(unread)} not read: only to begin with" if unread else ""
            say(f"going on in {folder} after lap {len(journal.record.laps)}{why}")
        elif given is not None:
            known = samples is not None and given.dataset_digest == samples.digest()
            stages = {} if known else {"kept": recalled(given, settings.car)}
            stages |= {} if samples is None else {"new": samples}
            journal.add_update(UpdateRecord(after_lap=0), given, **stages)
        elif samples is not None:
            journal.add_driven(samples)
        with open_session(endpoints) as session:
            Learner(session, settings, journal, say, track=track, beside=beside).run()
        draw(journal.record, beside, folder / "laps.png")
        return journal.record
