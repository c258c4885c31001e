"""Puts a predictive controller together from the files that describe it."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from bayesrace.controller.mpc import PredictiveController
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.path_table import PathTable, make_path_table
from bayesrace.controller.settings import MpcSettings
from bayesrace.controller.weights.adoption import WeightsPort
from bayesrace.controller.weights.checks import Checks
from bayesrace.controller.weights.settings import GateSettings
from bayesrace.controller.weights.store import AcceptedWeights, History, Store, digest_of
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole
from bayesrace.gp.weights import (
    GpWeights,
    decode_weights,
    encode_weights,
    read_weights,
)
from bayesrace.raceline import RaceLine, read_raceline_for
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import CarParameters

__all__ = ["compiled_controller", "predictive_controller", "read_checked", "read_settings"]

Settings = TypeVar("Settings", bound=BaseModel)


def read_settings(path: Path | None, form: type[Settings]) -> Settings:
    """Settings of that form from a JSON file; the defaults without one."""
    if path is None:
        return form()
    try:
        return form.model_validate_json(read_whole(path, "the settings"))
    except ValidationError as error:
        where = form.__module__.replace(".", "/")
        raise InputError(
            f"{path}: {faults_in(error, 'the file', form)}; {where}.py has the form"
        ) from None


def compiled_controller(
    artefact: Path,
    car: CarParameters,
    track: Track,
    line: RaceLine,
    weights: GpWeights | None = None,
    settings: MpcSettings | None = None,
    *,
    table: PathTable | None = None,
) -> PredictiveController:
    """The compiled controller of ``artefact`` on a track, ready to drive; without ``weights`` it
    predicts by the uncorrected model. ``table``: of track and line, where it is known already.

    Raises InputError if artefact, car, line or weights do not fit together.
    """
    step = NativeStep(artefact, car, settings or MpcSettings())
    step.set_path(table or make_path_table(track, line, car.tuning.path.spacing_m))
    if weights is not None:
        step.set_weights(weights)
    version = "" if weights is None else weights.version
    return PredictiveController(step, version, track=track.identity)


def read_checked(
    path: Path, artefact: Path, car: CarParameters, gate: GateSettings | None = None
) -> GpWeights:
    """Weights that may drive the car from the start, with the controller of ``artefact``; nothing
    watches them there. InputError names the file and what it fails."""
    weights = read_weights(path)
    try:
        Checks(gate or GateSettings(), artefact, car).check_start(encode_weights(weights))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return weights


def predictive_controller(
    artefact: Path,
    car: CarParameters,
    track: str | Path,
    raceline: Path,
    settings: Path | None = None,
    weights: Path | None = None,
    store: Path | None = None,
    gate: GateSettings | None = None,
) -> PredictiveController:
    """The compiled controller of ``artefact`` on a track, ready to drive.

    ``store``: folder of the weights that it accepts; the newest that an earlier controller kept
    there are in use from the start, in place of ``weights``. ``gate``: thresholds that ``weights``
    must pass; those in the store have passed them. InputError names the file that cannot be used.
    """
    loaded = None if weights is None else read_checked(weights, artefact, car, gate)
    driven_on = load_track(track, car.width_m)
    line = read_raceline_for(raceline, driven_on, car)
    mpc = read_settings(settings, MpcSettings)
    step = compiled_controller(artefact, car, driven_on, line, loaded, mpc).native
    version, data = ("", b"") if loaded is None else (loaded.version, encode_weights(loaded))
    first = AcceptedWeights(
        number=0,
        version=version,
        digest=digest_of(data),
        proven=True,
        data=data,
    )
    folder = None if store is None else Store(store, step.manifest.discretisation)
    history = History(entries=[first]) if folder is None else folder.restore(first)
    if (proven := history.reference) is not first:
        step.set_weights(decode_weights(proven.data))
    if history.in_use is not proven:  # a controller has ended while it watched them
        step.stage_weights(history.in_use.packed)
        step.adopt_weights()
    port = WeightsPort(artefact.resolve(), step, car, history, folder)
    return PredictiveController(step, history.in_use.version, port, driven_on.identity)
