"""The predictive controller: put together from the files that describe it, and as the cycle
drives it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from bayesrace.arrays import Floats
from bayesrace.controller.interface import StepOutput
from bayesrace.controller.native_step import Artefact, NativeStep, Status
from bayesrace.controller.settings import GateSettings, MpcSettings
from bayesrace.controller.weights.adoption import StepPort
from bayesrace.controller.weights.checks import Checks
from bayesrace.controller.weights.store import AcceptedWeights, History, Store, digest_of
from bayesrace.defaults import PATH_ROWS
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole
from bayesrace.gp.weights import (
    Weights,
    decode_weights,
    encode_weights,
    pack_weights,
    read_weights,
)
from bayesrace.manifest import Manifest
from bayesrace.messages import NOT_REPORTED
from bayesrace.raceline import RaceLine, read_raceline_for
from bayesrace.tracks import Track, load_track
from bayesrace.tracks.spline import PlaneSpline
from bayesrace.vehicles import Car

__all__ = [
    "PathTable", "PredictiveController", "compiled_controller", "make_path_table",
    "opened_history", "path_table_for", "predictive_controller", "read_checked", "read_settings",
]  # fmt: skip

Settings = TypeVar("Settings", bound=BaseModel)


ASTRAY_MAX: Final = 0.05
"""Share of a line that may be farther out than half the track's width: with more it belongs to
another track."""

_IN_C: Final = {
    "residual_dynamics": "defect",
    "residual_bounds": "bound",
    "residual_stationarity": "stationarity",
    "n_ref_m": "lateral_m",
}
"""Names in br_mpc_info, where they are not those of :class:`bayesrace.messages.Telemetry`."""


@dataclass(frozen=True, eq=False)
class PathTable:
    """Rows x, y, speed, left unit normal of the centreline (2), lower and upper bound of n . p.

    ``rows`` has shape (n, 7), sampled every ``spacing_m`` along the closed racing line.
    """

    rows: Floats
    spacing_m: float


def make_path_table(
    track: Track, line: RaceLine, spacing_m: float, most_rows: int = PATH_ROWS
) -> PathTable:
    """Samples the line and, at each sample's projection on the centreline, the two half-planes.

    The half-planes are parallel to the centreline (paper, equation 8d), their normal has length 1,
    their distance is the track's width there. ``spacing_m``: wanted distance of rows; between them
    the planner interpolates linearly; larger where there would be more than ``most_rows``.
    InputError if the line belongs to another track.
    """
    count = min(most_rows, max(8, math.ceil(line.length_m / spacing_m)))
    s: Floats = np.arange(count, dtype=np.float64) * (line.length_m / count)
    nodes = np.append(line.s_m, line.s_m[0] + line.length_m)
    xy = PlaneSpline(line.s_m, line.xy_m, line.length_m)(s)
    speed = np.interp(s, nodes, np.append(line.vx_mps, line.vx_mps[0]), period=line.length_m)
    on_track = track.project_path(xy)
    right, left = track.widths(on_track.s_m)
    astray = float(np.mean(on_track.off_track_m > (right + left) / 2))
    if astray > ASTRAY_MAX:
        raise InputError(
            f"{100 * astray:.0f} % of the racing line '{line.track_name}' is far outside the track "
            f"'{track.name}': it was computed for another track; run 'bayesrace raceline'"
        )
    normal = track.normal(on_track.s_m)
    along = np.sum(normal * track.position(on_track.s_m), axis=1)
    rows = np.column_stack([xy, speed, normal, along - right, along + left])
    return PathTable(np.ascontiguousarray(rows), line.length_m / count)


def path_table_for(manifest: Manifest, car: Car, track: Track, line: RaceLine) -> PathTable:
    """The table that a built controller has room for; InputError if its rows would be too far
    apart."""
    tuning = car.tuning.path
    manifest.check_rows(math.ceil(line.length_m / tuning.spacing_max_m))
    return make_path_table(track, line, tuning.spacing_m, manifest.path_rows)


class PredictiveController:
    """See :class:`.Controller`; BestCase, WorstCase and BayesRace alike."""

    def __init__(
        self,
        step: NativeStep,
        port: StepPort | None = None,
        track: str = "",
    ) -> None:
        """``step``: with parameters and path set. ``port``: how a process takes over new weights;
        without, it takes none. ``track``: identity of the track that the path is for."""
        self.native = step
        self.port = port
        self.track = track
        known = {name for name, _ in step.artefact.ffi.typeof("br_mpc_info").fields}
        names = ((name, _IN_C.get(name, name)) for name in NOT_REPORTED)
        self._numbers = [(name, in_c) for name, in_c in names if in_c in known]
        self._output = StepOutput(
            u=step.plan_u[0],
            plan_x=step.plan_x,
            plan_u=step.plan_u,
            tube_m=step.tube,
            plan_step_s=step.manifest.step_s,
        )

    last_error = ""
    """The cycle knows it."""
    nominal = None

    @property
    def artefact(self) -> Artefact:
        """What it was built as."""
        return self.native.artefact

    @property
    def weights_version(self) -> str:
        """Version of the weights in use; empty while there is no correction."""
        return self.native.weights_version

    def begin_cycle(self, memory: Any, size: int, hold: bool, cycle: Any) -> int:
        """With the compiled step, called from C."""
        native = self.native
        drive = native.artefact.library.br_cycle_drive_mpc
        return int(drive(memory, size, native.handle, hold, cycle))

    def raise_pending(self) -> None:
        """Nothing: its step is C."""

    def result(self, cycle: Any) -> StepOutput:
        """Of the cycle's last step; the plan, too, if it is not usable."""
        info = self.artefact.library.br_cycle_info(cycle)
        output = self._output
        self.native.read_plan()
        self.native.read_tube()
        # Acceptable and converged may both be driven; the residuals below distinguish them.
        output.status = 0 if info.status <= Status.ACCEPTABLE else info.status
        output.cost = info.cost
        output.cost_shifted = info.shifted_cost if info.shifts >= 0 else -1.0
        output.second_start = info.second_start
        output.numbers = {name: getattr(info, in_c) for name, in_c in self._numbers}
        return output


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
    car: Car,
    track: Track,
    line: RaceLine,
    weights: Weights | Path | None = None,
    settings: MpcSettings | None = None,
    *,
    table: PathTable | None = None,
    parameters: Mapping[str, float] | None = None,
) -> PredictiveController:
    """The compiled controller of ``artefact`` on a track, ready to drive.

    ``weights``, or their file: without, it predicts by the uncorrected model. ``table``: of track
    and line, where it is known already. ``parameters``: what the problem has beyond those of
    ``settings``.

    Raises InputError if artefact, car, line or weights do not fit together.
    """
    step = NativeStep(artefact, car, settings or MpcSettings(), parameters)
    step.set_path(table or path_table_for(step.manifest, car, track, line))
    if weights is not None:
        step.set_weights(read_weights(weights) if isinstance(weights, Path) else weights)
    return PredictiveController(step, track=track.identity)


def read_checked(path: Path, artefact: Path, car: Car, gate: GateSettings | None = None) -> Weights:
    """Weights that may drive the car from the start, with the controller of ``artefact``; nothing
    watches them there. InputError names the file and what it fails."""
    weights = read_weights(path)
    try:
        Checks(gate or GateSettings(), artefact, car).check_start(encode_weights(weights))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return weights


def opened_history(
    loaded: Weights | None, store: Path | None, discretisation: str
) -> tuple[History, Store | None]:
    """Weights that a controller accepts, after those that are loaded at its start; and the folder
    that keeps them. InputError if that cannot be used."""
    data, packed = (b"", b"") if loaded is None else (encode_weights(loaded), pack_weights(loaded))
    first = AcceptedWeights(
        number=0, version=loaded.version if loaded else "", digest=digest_of(data), proven=True,
        data=data, packed=packed,
    )  # fmt: skip
    folder = None if store is None else Store(store, discretisation)
    return History(entries=[first]) if folder is None else folder.restore(first), folder


def predictive_controller(
    artefact: Path,
    car: Car,
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
    must pass; those in the store have passed them. Where it has one buffer of weights it takes none
    while driving, and has no store. InputError names the file that cannot be used.
    """
    loaded = None if weights is None else read_checked(weights, artefact, car, gate)
    driven_on = load_track(track, car.width_m)
    line = read_raceline_for(raceline, driven_on, car)
    mpc = read_settings(settings, MpcSettings)
    controller = compiled_controller(artefact, car, driven_on, line, loaded, mpc)
    step = controller.native
    if step.manifest.weight_buffers == 1:
        if store is not None:
            raise InputError(
                f"{artefact} has one weight buffer: it takes no weights to keep in {store}; give "
                "no store, or build one with --weight-buffers 3"
            )
        return controller
    history, folder = opened_history(loaded, store, step.manifest.discretisation)
    in_use, proven = history.in_use, history.reference
    if proven is not history.entries[0]:
        step.set_weights(decode_weights(proven.data))
    if in_use is not proven:  # a controller has ended while it watched them
        step.stage_weights(in_use.packed)
        step.adopt_weights(in_use.version)
    port = StepPort(artefact.resolve(), car, history, folder, step)
    return PredictiveController(step, port, driven_on.identity)
