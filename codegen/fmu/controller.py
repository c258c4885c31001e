"""The predictive controller as a Co-Simulation FMU: the native step inside other tools.

The C side is ``native/controller.c``: it does with a state what ``controller/driver.py`` does in
lockstep. The sources of the step, DAQP included, come from a built artefact.
"""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Final, Literal

from numpy.typing import ArrayLike

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.manifest import Manifest, read_manifest
from bayesrace.native_interface import STATUSES
from bayesrace.vehicles.parameters import CarParameters
from codegen.compiler import FLAGS
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.resources import PATH_FILE, WEIGHTS_FILE, path_resource, weights_resource
from codegen.fmu.variables import Variable

__all__ = ["controller_fmu"]

_NATIVE: Final = Path(__file__).parent / "native"
_SOURCES: Final = (
    "controller.c",
    "controller_fallback.c",
    "controller_fallback.h",
    "controller_resources.c",
    "controller_resources.h",
)
_NOT_NEEDED: Final = ("br_clock.c",)
"""Of the artefact: without a clock there are no budgets, and two runs are equal."""

_PORTABLE: Final = "portable"
_CPU_FLAG: Final = "-march=native"

_STATE: Final = (
    ("x", "m", "position of the centre of gravity"),
    ("y", "m", "position of the centre of gravity"),
    ("psi", "rad", "heading, not wrapped"),
    ("vx", "m/s", "velocity along the car"),
    ("vy", "m/s", "velocity to the car's left"),
    ("omega", "rad/s", "yaw rate"),
    ("delta", "rad", "steering angle, positive to the left"),
)

_NO_LIMIT_MPS: Final = 100.0
"""NO_SPEED_LIMIT in C: the racing line knows no higher speed."""

_SETTINGS: Final = (
    ("q_position", "1/m2", True, "weight of the squared position error"),
    ("r_duty", "1", True, "weight of the squared change of the duty cycle"),
    ("r_delta_rate", "s2/rad2", True, "weight of the squared steering rate"),
    ("s_slack", "1/m2", False, "weight of the squared track violation; 0: no track constraints"),
    ("margin_m", "m", False, "distance kept from the track edges"),
    ("tolerance", "1", True, "KKT residual of a converged step"),
    ("defect_max", "1", True, "largest dynamics defect (m, rad, m/s, 10 rad/s) of a usable plan"),
    ("settle", "1", False, "a step ends at this stationarity and tenth of the defect; 0: neither"),
)
"""Name, unit, whether it must be above 0, description."""

_COUNTS: Final = (
    ("iterations", "SQP iterations that a step may use"),
    ("iterations_cold", "the same for the first step and after a reset"),
)

_STATUSES: Final = tuple(text for _, text, _ in STATUSES[:-1])
"""br_mpc_status in order, but for the last: a step without a budget is never out of time."""

_WITHOUT_STEP: Final = {
    "STATUS_UNPREDICTABLE": (252, "not predictable"),
    "STATUS_NO_STEP": (253, "none yet"),
    "STATUS_REFUSED": (255, "refused"),
}
"""Statuses of a cycle without a step: name in C, number as in ``controller/driver.py``, meaning."""

_FALLBACK: Final = (
    ("shifted_s", "shifted_s", "s", False, "how long a plan may be driven without a new one"),
    ("tolerance", "limit_tolerance", "1", False, "excess over a limit that is clipped"),
    ("brake_fade_mps", "brake_fade_mps", "m/s", True, "speed below which braking fades to none"),
)
"""Name in the settings, name here, unit, whether it must be above 0, description."""


def controller_fmu(
    artefact: Path,
    car: CarParameters,
    rows: ArrayLike,
    spacing_m: float,
    settings: Mapping[str, float],
    fallback: Mapping[str, float],
    weights: GpWeights | None = None,
    version: Literal[2, 3] = 3,
    cpu: str = _PORTABLE,
) -> FmuDefinition:
    """The controller of a built artefact on one racing line, ready for :func:`codegen.fmu.pack`.

    ``rows`` (n, 7), ``spacing_m``: the table of ``controller.path_table``; ``settings``: the fields
    of ``controller.settings.MpcSettings``; ``fallback``: those of ``FallbackSettings``; both become
    start values of parameters. ``cpu``: "portable" runs on any of its kind; "native" only on one
    like this, faster, and gives the bits of the artefact's own library; else a value for the
    compiler's ``-march``. InputError for an artefact of another car, foreign weights, a bad table.
    """
    manifest = read_manifest(artefact)
    if (manifest.car, manifest.car_digest) != (car.name, car.digest()):
        raise InputError(
            f"{artefact} was built for car '{manifest.car}-{manifest.car_digest}', not "
            f"'{car.name}-{car.digest()}': run 'bayesrace build'"
        )
    sources = [path for path in sorted(artefact.glob("*.[ch]")) if path.name not in _NOT_NEEDED]
    return FmuDefinition(
        name=f"BayesRace controller ({car.name}, {manifest.model})",
        identifier="bayesrace_controller",
        description=f"GP-MPC racing controller for the car '{car.name}', {manifest.model} model",
        version=version,
        kind="cs",
        variables=_variables(manifest, car, settings, fallback),
        sources=(*(_NATIVE / name for name in _SOURCES), *sources),
        trees={"daqp": artefact / "daqp"},
        archives=(artefact / "libdaqpstat.a",),
        flags=_flags(cpu),
        constants={
            "CONTROLLER_IDENTITY": manifest.discretisation,
            "NO_SPEED_LIMIT": _NO_LIMIT_MPS,
            **{name: number for name, (number, _) in _WITHOUT_STEP.items()},
        },
        resources={
            PATH_FILE: path_resource(rows, spacing_m),
            WEIGHTS_FILE: weights_resource(weights, manifest.discretisation, manifest.gp_capacity),
        },
        documentation=_documentation(manifest, weights, cpu),
        default_step_s=manifest.step_s,
        saves="instance",  # DAQP's workspace points into the same block of memory
    )


def _flags(cpu: str) -> tuple[str, ...]:
    """The artefact's own but for the CPU; portable ones give the same bits on every CPU."""
    if cpu == _PORTABLE:
        own = [flag for flag in FLAGS if flag not in (_CPU_FLAG, "-ffp-contract=fast")]
        return (*own, "-ffp-contract=off")
    if not cpu.replace("-", "").replace("_", "").replace(".", "").isalnum():
        raise InputError(f"'{cpu}' is not a CPU: portable, native, or one such as x86-64-v3")
    return tuple(f"-march={cpu}" if flag == _CPU_FLAG else flag for flag in FLAGS)


def _variables(
    manifest: Manifest,
    car: CarParameters,
    settings: Mapping[str, float],
    fallback: Mapping[str, float],
) -> tuple[Variable, ...]:
    return (
        *_inputs(),
        *_objective(settings),
        *_limits(car),
        *_timing(manifest, fallback),
        *_outputs(),
    )


def _inputs() -> list[Variable]:
    state = [
        Variable(name, "input", f"measured: {text}", unit=unit, start=0.0)
        for name, unit, text in _STATE
    ]
    return [
        *state,
        Variable(
            "d_applied",
            "input",
            "duty cycle that acts now; looked at if d_applied_connected, else it is taken to be "
            "the one sent last",
            unit="1",
            start=0.0,
        ),
        Variable(
            "speed_limit",
            "input",
            f"the reference moves along the racing line no faster; {_NO_LIMIT_MPS:g}: no limit",
            unit="m/s",
            start=_NO_LIMIT_MPS,
        ),
        Variable(
            "speed_limit_rate",
            "input",
            "by how much the limit falls along the horizon, for a stop on the line",
            unit="m/s2",
            start=0.0,
        ),
    ]


def _objective(settings: Mapping[str, float]) -> list[Variable]:
    def start(name: str) -> float:
        off = name == "s_slack" and not settings.get("constraints", True)
        return 0.0 if off else float(_value(settings, name))

    reals = [
        _parameter(name, unit, text, start(name), positive)
        for name, unit, positive, text in _SETTINGS
    ]
    counts = [
        Variable(
            name, "parameter", text, "integer", start=start(name), min=1, max=1000, tunable=True
        )
        for name, text in _COUNTS
    ]
    return [*reals, *counts]


def _limits(car: CarParameters) -> list[Variable]:
    d_min, d_max = "lowest duty cycle (full brake)", "highest duty cycle"
    return [
        Variable("d_min", "parameter", d_min, unit="1", start=car.d_min, max=0.0, tunable=True),
        Variable("d_max", "parameter", d_max, unit="1", start=car.d_max, min=0.0, tunable=True),
        _parameter("delta_max_rad", "rad", "limit of the steering angle", car.delta_max_rad, True),
        _parameter(
            "delta_rate_max_radps",
            "rad/s",
            "limit of the steering rate",
            car.delta_rate_max_radps,
            True,
        ),
    ]


def _timing(manifest: Manifest, fallback: Mapping[str, float]) -> list[Variable]:
    return [
        *(
            _parameter(name, unit, f"fallback: {text}", float(_value(fallback, key)), positive)
            for key, name, unit, positive, text in _FALLBACK
        ),
        Variable(
            "recover_cycles",
            "parameter",
            "fallback: usable solutions in a row that end braking; a standing car drives the first",
            "integer",
            start=float(_value(fallback, "recover_cycles")),
            min=1,
            max=100,
            tunable=True,
        ),
        Variable(
            "period",
            "parameter",
            "time between two control steps, outputs held in between; 0: one in every doStep",
            unit="s",
            start=manifest.step_s,
            min=0.0,
            max=1.0,
        ),
        Variable(
            "delay",
            "parameter",
            "time from the state to the new input acting, over which it is predicted: the "
            "communication step if the importer steps plant and controller side by side",
            unit="s",
            start=0.0,
            min=0.0,
            max=0.5,
        ),
        Variable(
            "d_applied_connected",
            "parameter",
            "d_applied is connected",
            "boolean",
            start=0.0,
        ),
    ]


def _outputs() -> list[Variable]:
    def output(
        name: str, text: str, kind: Literal["real", "integer", "boolean"], unit: str | None = None
    ) -> Variable:
        return Variable(name, "output", text, kind, unit, dependencies=None)

    numbered = (*enumerate(_STATUSES), *_WITHOUT_STEP.values())
    statuses = ", ".join(f"{number} {text}" for number, text in numbered)
    return [
        output("d", "duty cycle", "real", "1"),
        output("delta_rate", "steering rate", "real", "rad/s"),
        output("status", f"of the step: {statuses}", "integer"),
        output("usable", "the step's solution may be driven", "boolean"),
        output(
            "fallback_level", "0 the solution, 1 the plan before, 2 braking, 3 standing", "integer"
        ),
        output("iterations_used", "SQP iterations of the step", "integer"),
        output("stationarity", "residual at the plan; -1: not known", "real", "1"),
        output("defect", "dynamics residual at the plan; -1: not known", "real", "1"),
        output("slack_max_m", "largest violation of the track in the plan", "real", "m"),
        output("s_ref_m", "arc length of the car on the racing line", "real", "m"),
        output("lateral_m", "distance from the racing line, positive to the left", "real", "m"),
    ]


def _parameter(name: str, unit: str, text: str, start: float, positive: bool) -> Variable:
    return Variable(
        name,
        "parameter",
        text,
        unit=unit,
        start=start,
        min=0.0,
        exclusive=positive,
        tunable=True,
    )


def _value(values: Mapping[str, float], name: str) -> float:
    try:
        return values[name]
    except KeyError:
        raise InputError(f"the controller's settings lack '{name}'") from None


def _documentation(manifest: Manifest, weights: GpWeights | None, cpu: str) -> str:
    correction = "no correction" if weights is None else f"weights '{escape(weights.version)}'"
    return (
        f"<p>Nonlinear model predictive controller, {manifest.horizon} stages of "
        f"{manifest.step_s:g} s, model {escape(manifest.discretisation)}, {correction}.</p>"
        "<p>Every doStep in which a control step is due makes one for the inputs set before it. "
        "Its outputs are meant for the plant's step over the same time. So step the controller "
        "first, hand its outputs to the plant, and step that. If your tool steps all FMUs side by "
        "side, set <code>delay</code> to the communication step.</p>"
        "<p>A step that gives no usable solution is answered by the plan before it, then by "
        "braking along it; <code>fallback_level</code> tells. What is not finite is never passed "
        "on.</p>"
        f"<p>Racing line and weights are in <code>resources/{PATH_FILE}</code> and "
        f"<code>resources/{WEIGHTS_FILE}</code> (format: sources/controller_resources.h), loaded "
        "and checked at instantiation: exchange them without compiling.</p>"
        f"<p>The binary is compiled for the CPU '{escape(cpu)}'.</p>"
    )
