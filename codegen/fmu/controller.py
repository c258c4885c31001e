"""The predictive controller as a Co-Simulation FMU: the native step inside other tools.

The C side is ``native/controller.c``, around the control cycle of ``controller/native``. The
sources of the step, DAQP included, come from a built artefact.
"""

from collections.abc import Mapping
from html import escape
from math import isfinite
from pathlib import Path
from typing import Final, Literal

from numpy.typing import ArrayLike

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.manifest import Manifest, read_manifest
from bayesrace.native_interface import NO_STEP, SOLVER, STATUSES
from bayesrace.vehicles.parameters import CarParameters
from codegen.build import HOST
from codegen.compiler import FLAGS
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.variables import Variable
from codegen.host_files import PATH_FILE, WEIGHTS_FILE, path_file, weights_file

__all__ = ["controller_fmu"]

_NATIVE: Final = Path(__file__).parent / "native"
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

_STATUSES: Final = tuple(text for _, text, _ in STATUSES[:-1])
"""br_mpc_status in order, but for the last: a step without a budget is never out of time."""

_WITHOUT_STEP: Final = {"UNPREDICTABLE": "not predictable", "HALTED": "none yet",
                        "STEP_FAILED": "refused"}  # fmt: skip
"""Of :data:`bayesrace.native_interface.NO_STEP`, those of an FMU, and what they mean here."""

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

    ``rows`` (n, 7), ``spacing_m``: the table of ``controller.path_table``; ``settings``: the
    parameters of problem and solver (``controller.settings.MpcSettings.parameters``); ``fallback``:
    the fields of ``FallbackSettings``; both become start values of parameters. ``cpu``: "portable"
    runs on any of its kind; "native" only on one like this, faster, and gives the bits of the
    artefact's own library; else a value for the compiler's ``-march``. InputError for an artefact
    of another car, foreign weights, a bad table.
    """
    manifest = read_manifest(artefact)
    manifest.check_car(car, artefact)
    sources = [*sorted(artefact.glob("*.[ch]")), *sorted((artefact / HOST).iterdir())]
    sources = [path for path in sources if path.name not in _NOT_NEEDED]
    return FmuDefinition(
        name=f"BayesRace controller ({car.name}, {manifest.model})",
        identifier="bayesrace_controller",
        description=f"GP-MPC racing controller for the car '{car.name}', {manifest.model} model",
        version=version,
        kind="cs",
        variables=_variables(manifest, settings, fallback),
        sources=(_NATIVE / "controller.c", *sources),
        trees={"daqp": artefact / "daqp"},
        archives=(artefact / "libdaqpstat.a",),
        flags=_flags(cpu),
        constants={
            "NO_SPEED_LIMIT": _NO_LIMIT_MPS,
        },
        resources={
            PATH_FILE: path_file(rows, spacing_m),
            WEIGHTS_FILE: weights_file(weights, manifest.discretisation, manifest.gp_capacity),
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
    manifest: Manifest, settings: Mapping[str, float], fallback: Mapping[str, float]
) -> tuple[Variable, ...]:
    return (
        *_inputs(),
        *_parameters(manifest, settings),
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


def _parameters(manifest: Manifest, settings: Mapping[str, float]) -> list[Variable]:
    """The problem's and the solver's."""

    def start(name: str) -> float:
        return float(_value(settings, name))

    own = [
        Variable(
            one.name,
            "parameter",
            one.text,
            unit=one.unit,
            start=start(one.name),
            min=0.0 if one.positive else one.low if isfinite(one.low) else None,
            max=one.high if isfinite(one.high) else None,
            exclusive=one.positive,
            tunable=True,
        )
        for one in manifest.problem.parameters
    ]
    of_solver = [
        _parameter(name, "1", text, start(name), rule == "> 0")
        if kind == "double"
        else Variable(
            name, "parameter", text, "integer", start=start(name), min=1, max=1000, tunable=True
        )
        for name, kind, text, rule in SOLVER
    ]
    return [*own, *of_solver]


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

    others = ((n, _WITHOUT_STEP[name]) for name, n, _ in NO_STEP if name in _WITHOUT_STEP)
    numbered = (*enumerate(_STATUSES), *others)
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
        f"<code>resources/{WEIGHTS_FILE}</code> (format: sources/br_files.h), loaded "
        "and checked at instantiation: exchange them without compiling.</p>"
        f"<p>The binary is compiled for the CPU '{escape(cpu)}'.</p>"
    )
