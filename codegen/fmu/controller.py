"""The predictive controller as a Co-Simulation FMU: the native step inside other tools.

The C side is ``native/controller.c``, around the control cycle of ``controller/native``. The
sources of the step, DAQP included, come from a built artefact.
"""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any, Final, Literal

from numpy.typing import ArrayLike

from bayesrace.codegen.build import HOST, archives_of
from bayesrace.codegen.compiler import FLAGS
from bayesrace.codegen.fmu.build import NATIVE, FmuDefinition, Variable
from bayesrace.codegen.fmu.car import STATE
from bayesrace.codegen.fmu.readings import reading_inputs, reading_tables
from bayesrace.codegen.host_files import PATH_FILE, WEIGHTS_FILE, path_file, weights_file
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.manifest import Manifest, read_manifest
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import Drive

__all__ = ["controller_fmu"]

_NO_LIMIT_MPS: Final = 100.0
"""NO_SPEED_LIMIT in C: the racing line knows no higher speed."""

_FALLBACK: Final = (
    ("shifted_s", "shifted_s", "s", False, "how long a plan may be driven without a new one"),
    ("tolerance", "limit_tolerance", "1", False, "excess over a limit that is clipped"),
    ("brake_fade_mps", "brake_fade_mps", "m/s", True, "speed below which braking fades to none"),
)
"""Name in the settings, name here, unit, whether it must be above 0, meaning."""

_ABOVE_0: Final[dict[str, Any]] = {"unit": "1", "min": 0.0, "exclusive": True}
_FROM_0: Final[dict[str, Any]] = {"unit": "1", "min": 0.0}
_COUNT: Final[dict[str, Any]] = {"kind": "integer", "min": 1, "max": 1000}

_SOLVER: Final = (
    ("tolerance", _ABOVE_0, "KKT residual (scaled) of a converged step"),
    ("defect_max", _ABOVE_0, "largest dynamics defect of a usable plan"),
    ("early_stop_tol", _FROM_0,
     "a step ends at this stationarity and tenth of it as defect, or earlier: see br_step.c"),
    ("caution_sigmas", _FROM_0,
     "standard deviations of the residual that a plan's tube is wide to either side; 0: none"),
    ("iterations", _COUNT,
     "SQP iterations a step without budget may use, once the defect is below 0.01"),
    ("iterations_cold", _COUNT,
     "the same for the first step after a reset; with a budget the larger limits every step"),
    ("qp_steps", _COUNT | {"min": 200, "max": 1_000_000},
     "active-set steps that all QPs of a step may take together"),
)  # fmt: skip
"""BR_SOLVER_FIELDS in controller/native/bayesrace_mpc.h: name, bounds, meaning."""

_PLANNED: Final = (
    ("pace", "1", "of the reference, as a share of the line's speed"),
    ("widening", "1", "of the model's band by what is not known of its mismatch; 1: nothing"),
    ("s_ref_m", "m", "arc length of the car on the racing line"),
    ("lateral_m", "m", "distance from the racing line, positive to the left"),
)
"""Outputs with the names of br_mpc_info that stay as they are where a step makes no plan."""

_STATUSES: Final = (
    "0 converged, 1 acceptable, 2 dynamics defect too large, 3 QP infeasible, "
    "4 QP iteration limit, 5 not finite, 6 bad state, 251 states contradict each other, "
    "252 not predictable, 253 none yet, 254 position not known, 255 refused"
)
"""br_mpc_status in controller/native/bayesrace_mpc.h and br_no_step in bayesrace_cycle.h. A step
without a budget is never out of time."""


def controller_fmu(
    artefact: Path,
    car: Car,
    *,
    rows: ArrayLike,
    spacing_m: float,
    settings: Mapping[str, float],
    fallback: Mapping[str, float],
    weights: Weights | None = None,
    version: Literal[2, 3] = 3,
) -> FmuDefinition:
    """The controller of a built artefact on one racing line, ready for
    :func:`bayesrace.codegen.fmu.pack`.

    ``rows`` (n, 7), ``spacing_m``: the table of ``bayesrace.controller.assembly``; ``settings``:
    the parameters of problem and solver (``bayesrace.controller.settings.MpcSettings.parameters``);
    ``fallback``: the fields of ``FallbackSettings``; both become start values of parameters. Built
    by the same compiler, it gives the bits of the artefact's own library on the same processor.
    InputError for an artefact of another car, foreign weights, a bad table.
    """
    manifest = read_manifest(artefact)
    manifest.check_car(car, artefact)
    brake = car.brake_numbers
    return FmuDefinition(
        name=f"BayesRace controller ({car.name}, {manifest.model})",
        identifier="bayesrace_controller",
        description=f"GP-MPC racing controller for the car '{car.name}', {manifest.model} model",
        version=version,
        variables=tuple(_variables(manifest, car, settings, fallback)),
        sources=_sources(artefact, car, nominal=weights is None),
        flags=FLAGS,
        constants={
            "NO_SPEED_LIMIT": _NO_LIMIT_MPS,
            **{name.upper(): brake[name] for name in ("brake_d", "brake_slow")},
        },
        resources={
            PATH_FILE: path_file(rows, spacing_m, manifest),
            WEIGHTS_FILE: weights_file(weights, manifest.discretisation, manifest.gp_capacity),
        },
        documentation=_documentation(manifest, car, weights),
        default_step_s=manifest.step_s,
        serialises=False,  # DAQP's workspace points into the same block of memory
    )


def _sources(artefact: Path, car: Car, *, nominal: bool) -> dict[str, bytes]:
    """Of the artefact all but its clock: without one there are no budgets; two runs are equal."""
    own = {*artefact.glob("*.[ch]"), *(artefact / HOST).glob("br_files.*")}
    own.remove(artefact / "br_clock.c")
    files = {path.name: path for path in (NATIVE / "controller.c", *own, *archives_of(artefact))}
    files |= {f"daqp/{path.name}": path for path in (artefact / "daqp").iterdir()}
    planned = " ".join(f"X({name})" for name, *_ in _PLANNED)
    tables = reading_tables(car.sensors, car.tuning.estimation(nominal=nominal))
    made = {"controller_tables.h": f"#define PLANNED(X) {planned}\n{tables}".encode()}
    return made | {name: path.read_bytes() for name, path in sorted(files.items())}


def _value(values: Mapping[str, float], name: str) -> float:
    if name not in values:
        raise InputError(f"the controller's settings lack '{name}'")
    return float(values[name])


def _variables(
    manifest: Manifest,
    car: Car,
    settings: Mapping[str, float],
    fallback: Mapping[str, float],
) -> list[Variable]:
    """In the order that controller.c relies on: the state together, the outputs last."""
    drive = car.drive
    acts = (
        f"{drive.command} that acts now, read if d_applied_connected; else taken to be the last "
        "output"
    )
    limit = f"the reference moves along the racing line no faster; {_NO_LIMIT_MPS:g}: no limit"
    rate = "by how much the limit falls along the horizon, for a stop on the line"
    seen = list(reading_inputs(car.sensors)) or [
        Variable(name, "input", f"measured: {text}", unit=unit, start=0.0)
        for name, (unit, text) in STATE.items()
    ]
    return [
        *seen,
        Variable("d_applied", "input", acts, unit=drive.unit, start=0.0),
        Variable("speed_limit", "input", limit, unit="m/s", start=_NO_LIMIT_MPS),
        Variable("speed_limit_rate", "input", rate, unit="m/s2", start=0.0),
        *_parameters(manifest, settings, fallback),
        *_outputs(drive),
    ]


def _parameters(
    manifest: Manifest, settings: Mapping[str, float], fallback: Mapping[str, float]
) -> list[Variable]:
    """Of the problem, the solver, the fallback, and when steps are made."""

    def tunable(name: str, text: str, start: float, **others: Any) -> Variable:
        return Variable(name, "parameter", text, start=start, tunable=True, **others)

    recover = "fallback: usable solutions that end braking; a standing car drives the first"
    period = "time between two control steps, outputs held in between; 0: one in every doStep"
    delay = (
        "time from the state to the new input acting, over which it is predicted: the "
        "communication step if the importer steps plant and controller side by side"
    )
    connected = "d_applied is connected"
    believed = "multiple of the contradictions beyond which a state is not believed; 0: each is"
    return [
        *(tunable(one.name, one.text, _value(settings, one.name), unit=one.unit, max=one.high,
                  min=0.0 if one.positive else one.low, exclusive=one.positive)
          for one in manifest.problem.parameters),
        *(tunable(name, text, _value(settings, name), **bounds)
          for name, bounds, text in _SOLVER),
        *(tunable(name, f"fallback: {text}", _value(fallback, key), unit=unit, min=0.0,
                  exclusive=positive)
          for key, name, unit, positive, text in _FALLBACK),
        tunable("recover_cycles", recover, _value(fallback, "recover_cycles"), kind="integer",
                min=1, max=100),
        tunable("sensor_tolerance", believed, 1.0, unit="1", min=0.0, max=1e3),
        Variable("period", "parameter", period, unit="s", start=manifest.step_s, min=0.0, max=1.0),
        Variable("delay", "parameter", delay, unit="s", start=0.0, min=0.0, max=0.5),
        Variable("d_applied_connected", "parameter", connected, kind="boolean", start=0.0),
    ]  # fmt: skip


def _outputs(drive: Drive) -> list[Variable]:
    def output(name: str, what: str, text: str) -> Variable:
        how: dict[str, Any] = {"kind" if what in ("integer", "boolean") else "unit": what}
        return Variable(name, "output", text, dependencies=None, **how)

    return [
        output(*row)
        for row in (
            ("d", drive.unit, drive.command),
            ("delta_rate", "rad/s", "steering rate"),
            ("status", "integer", f"of the step: {_STATUSES}"),
            ("usable", "boolean", "the step's solution may be driven"),
            ("fallback_level", "integer", "0 solution, 1 plan before, 2 braking, 3 standing"),
            ("iterations_used", "integer", "SQP iterations of the step"),
            ("stationarity", "1", "residual at the plan; -1: not known"),
            ("defect", "1", "dynamics residual at the plan; -1: not known"),
            ("slack_max_m", "m", "largest violation of the track in the plan"),
            ("tube_m", "m", "half the width that uncertainty takes of the track; -1: not known"),
            *_PLANNED,
        )
    ]


_READ: Final = """<p>The state is estimated of what instruments measure:
<code>sensor_NAME_time</code> and their values. A reading is new if its time differs from the one
before; every doStep takes one of each instrument. Connect what acts, <code>d_applied</code> and
<code>delta_rate_applied</code>, and set <code>d_applied_connected</code>.</p>
"""


def _documentation(manifest: Manifest, car: Car, weights: Weights | None) -> str:
    correction = "no correction" if weights is None else f"weights '{escape(weights.version)}'"
    return f"""<p>Nonlinear model predictive controller, {manifest.horizon} stages of
{manifest.step_s:g} s, model {escape(manifest.discretisation)}, {correction}. On x86-64 the binary
uses AVX2 or AVX-512 where the processor has them.</p>
<p>Every doStep in which a control step is due makes one for the inputs set before it; its outputs
are meant for the plant's step over the same time. So step the controller first, hand its outputs to
the plant, and step that; or, if your tool steps all FMUs side by side, set <code>delay</code> to
the communication step. Without a usable solution, the outputs are those of the plan before it, then
of braking along it (<code>fallback_level</code>). They are always finite.</p>
{_READ if car.sensors.root else ""}
<p>A tunable parameter outside its bounds is refused with the status Discard. Parameters that do not
fit together, such as <code>d_min</code> above <code>d_max</code>, make the next control step return
Warning, and all have the values of the step before again. The simulation may go on after both.</p>
<p>Racing line and weights are in <code>resources/{PATH_FILE}</code> and
<code>resources/{WEIGHTS_FILE}</code> (format: sources/br_files.h), loaded and checked at
instantiation: exchange them without compiling.</p>"""
