"""Puts a predictive controller together from the files that describe it."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole
from bayesrace.gp.weights import GpWeights, decode_weights, encode_weights, read_weights
from bayesrace.raceline import RaceLine, read_raceline_for
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import CarParameters
from controller.gate.store import Accepted, Store
from controller.mpc import PredictiveController
from controller.native_step import NativeStep
from controller.path_table import make_path_table
from controller.settings import MpcSettings
from controller.takeover import WeightsPort

__all__ = ["compiled_controller", "predictive_controller", "read_settings"]

Settings = TypeVar("Settings", bound=BaseModel)


def read_settings(path: Path | None, form: type[Settings]) -> Settings:
    """Settings of that form from a JSON file; the defaults without one."""
    if path is None:
        return form()
    try:
        return form.model_validate_json(read_whole(path, "the settings"))
    except ValidationError as error:
        where = form.__module__.replace(".", "/")
        raise InputError(f"{path}: {faults_in(error)}; {where}.py has the form") from None


def compiled_controller(
    artefact: Path,
    car: CarParameters,
    track: Track,
    line: RaceLine,
    weights: GpWeights | None = None,
    settings: MpcSettings | None = None,
) -> PredictiveController:
    """The compiled controller of ``artefact`` on a track, ready to drive; without ``weights`` it
    predicts by the uncorrected model.

    Raises InputError if artefact, car, line or weights do not fit together.
    """
    step = NativeStep(artefact, car, settings or MpcSettings())
    step.set_path(make_path_table(track, line, car.tuning.path.spacing_m))
    if weights is not None:
        step.set_weights(weights)
    return PredictiveController(step, "" if weights is None else weights.version)


def predictive_controller(
    artefact: Path,
    car: CarParameters,
    track: str | Path,
    raceline: Path,
    settings: Path | None = None,
    weights: Path | None = None,
    store: Path | None = None,
) -> PredictiveController:
    """The compiled controller of ``artefact`` on a track, ready to drive.

    ``store``: folder of the weights that it accepts; the newest of an earlier life are in use from
    the start, whatever ``weights`` are. Raises InputError naming the file that cannot be used.
    """
    loaded = None if weights is None else read_weights(weights)
    course = load_track(track, car.width_m)
    line = read_raceline_for(raceline, course, car)
    mpc = read_settings(settings, MpcSettings)
    step = compiled_controller(artefact, car, course, line, loaded, mpc).native
    first = Accepted(0, "", b"", proven=True)
    if loaded is not None:
        first = Accepted(0, loaded.version, encode_weights(loaded), proven=True)
    port = WeightsPort(artefact.resolve(), step, car, [first])
    if store is not None:
        _restore(port, Store(store, step.manifest.discretisation))
        port.store = store
    return PredictiveController(step, port.history[-1].version, port)


def _restore(port: WeightsPort, store: Store) -> None:
    """Takes up what an earlier controller has accepted."""
    kept = store.load()
    port.history += kept
    port.next_number, port.withdrawn = store.next_number, list(store.withdrawn)
    if kept:
        port.step.set_weights(decode_weights(kept[-1].data))
