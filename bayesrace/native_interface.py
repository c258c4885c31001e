"""The tables that the controller's C and its Python binding share, written down once.

``codegen`` writes them as C (br_interface.h), ``controller`` as ctypes. What depends on the
problem (sizes, parameters) is in each artefact's manifest instead.
"""

import zlib
from collections.abc import Iterable
from typing import Final

__all__ = [
    "ABI",
    "BRAKING",
    "BRAKING_ROWS",
    "COMPENSATIONS",
    "COUNTERS",
    "DECISION",
    "DELAYS",
    "DRIVING",
    "ENVIRONMENT",
    "ERRORS",
    "FAULTS",
    "INFO",
    "INSTRUCTIONS",
    "LEVELS",
    "MEASURED",
    "NO_STEP",
    "PHASES",
    "RECEPTIONS",
    "SAMPLES",
    "SOLUTION",
    "SOLVER",
    "STATUSES",
    "WATCH",
    "WATCHED",
    "c_fields",
    "c_interface",
]

SOLVER: Final = (
    ("tolerance", "double", "KKT residual (scaled) of a converged step", "> 0"),
    ("defect_max", "double", "largest dynamics defect of a usable plan", "> 0"),
    (
        "early_stop_tol",
        "double",
        "a step ends at this stationarity and tenth of it as defect, or earlier: see br_step.c",
        ">= 0",
    ),
    (
        "caution_sigmas",
        "double",
        "standard deviations of the residual by which rows are tightened; 0: none",
        ">= 0",
    ),
    (
        "iterations",
        "int",
        "SQP iterations a step without budget may use, once the defect is below 0.01",
        ">= 1",
    ),
    (
        "iterations_cold",
        "int",
        "the same for the first step after a reset; with a budget the larger limits every step",
        ">= 1",
    ),
)
"""Settings of the solver: name, type, meaning, range. They follow the problem's parameters."""

INFO: Final = (
    ("status", "int", "br_mpc_status"),
    ("iterations", "int", "SQP iterations used, those of a second start included"),
    ("qp_iterations", "int", "active-set iterations, summed"),
    ("regularised", "int", "iterations whose Hessian had to be made positive definite"),
    ("shortened", "int", "steps that the line search halved"),
    (
        "second_start",
        "int",
        "1: the plan from before was doubtful, and a new one no better; 2: the new one is better",
    ),
    ("shifts", "int", "stages by which the plan was shifted; -1: there was no plan"),
    ("prepared", "int", "1: br_mpc_prepare had linearised and factorised already"),
    ("prepared_iterations", "int", "SQP iterations of br_mpc_prepare since the step before"),
    ("time_limited", "int", "1: the budget ended the iterations"),
    ("stationarity", "double", "scaled infinity norms at the returned plan: of the gradient,"),
    ("defect", "double", "of the dynamics,"),
    ("bound", "double", "of the hard constraints"),
    (
        "shifted_cost",
        "double",
        "of the plan before, shifted, under the same reference; 0 after a cold start",
    ),
    ("cost", "double", "objective at the returned plan, slack included"),
    ("slack_max_m", "double", "largest violation of a soft constraint"),
    ("tube_m", "double", "half the width that uncertainty takes of a soft constraint, the largest"),
    ("pace", "double", "of the reference, as a share of the line's speed; 1 where all is known"),
    (
        "widening",
        "double",
        "of the residual's standard deviations by the errors observed; 1: they cover these",
    ),
    ("s_ref_m", "double", "projection of the car on the racing line"),
    ("lateral_m", "double", "distance of the car from the racing line, positive left"),
)
"""What a step reports: name, type, meaning."""

STATUSES: Final = (
    ("CONVERGED", "converged", "all residuals below tolerance"),
    ("ACCEPTABLE", "acceptable", "dynamics and bounds hold; not stationary to tolerance"),
    ("DEFECT", "dynamics defect too large", "the dynamics are violated by more than defect_max"),
    ("INFEASIBLE", "QP infeasible", "the QP has no solution"),
    ("QP_LIMIT", "QP iteration limit", "the QP solver hit its iteration limit or cycled"),
    ("NOT_FINITE", "not finite", "a number in the problem or its solution is not finite"),
    ("BAD_STATE", "bad state", "the measured state is not finite or absurd; nothing was solved"),
    (
        "TIME_LIMIT",
        "out of time before the plan was usable",
        "the budget was used up before the plan was usable",
    ),
)
"""What becomes of the optimisation problem, from 0 on: name, text, meaning. 0 and 1 are usable."""

ERRORS: Final = (
    ("OK", "no error"),
    ("ERROR_NULL", "a required pointer is NULL"),
    ("ERROR_MEMORY", "memory block too small or not aligned to 64 bytes"),
    ("ERROR_PARAMETERS", "a parameter is not finite or out of its range"),
    ("ERROR_PATH", "path table is unusable"),
    ("ERROR_WEIGHTS", "GP weights are unusable"),
    ("ERROR_NOT_READY", "parameters or path have not been set"),
    ("ERROR_TIME", "a time is negative, not finite or too long"),
    ("ERROR_STATE", "a state or input is not finite or absurd"),
    ("ERROR_BUSY", "another thread is staging weights"),
    ("ERROR_NOT_STAGED", "no weights are staged"),
    ("ERROR_INSTRUCTIONS", "this processor lacks these instructions"),
)
"""What is wrong with a call, from 0 on: name, text."""

INSTRUCTIONS: Final = (
    ("BASELINE", "those that every processor of its kind has"),
    ("AVX2", "x86-64 with AVX2 and fused multiply-add"),
    ("AVX512", "x86-64 with AVX-512"),
)
"""Instruction sets that a library has code for, from 0 on: name, meaning."""

NO_STEP: Final = (
    ("DOUBTED", 251, "the states contradict each other, for longer than they may be old"),
    ("UNPREDICTABLE", 252, "the state cannot be predicted to the moment of acting"),
    ("HALTED", 253, "the car is not to be driven"),
    ("NO_STATE", 254, "the newest state is too old"),
    ("STEP_FAILED", 255, "the step is broken: an exception, or a call that it refuses"),
)
"""Statuses of a cycle without a result of a step: name, number, meaning."""

LEVELS: Final = (
    ("SOLUTION", "the solution"),
    ("SHIFTED_PLAN", "the plan before, shifted"),
    ("BRAKE", "braking along the plan's steering, held when the plan is over"),
    ("STOP", "standing still"),
)
"""Levels of the fallback, from 0 on: name, where the input comes from."""

PHASES: Final = (
    ("WAITING", "for a state"),
    ("READY", "states arrive; go has not been said"),
    ("DRIVING", "the input is the solution"),
    ("FALLBACK", "the input is the fallback's"),
    ("STOPPED", "stop has been said: the car brakes to standstill, and stays"),
)
"""Life cycle of a controller, from 0 on: name, meaning."""

FAULTS: Final = (
    ("NONE", "the state is believed"),
    ("FROZEN", "it is equal to the state before, though the car moves"),
    ("TIME", "its time does not follow from its number"),
    ("POSITION", "the position does not follow from the velocities"),
    ("HEADING", "the heading does not follow from the yaw rate"),
    ("VELOCITY", "the velocity changes faster than tyres can make it"),
    ("YAW_RATE", "the yaw rate changes faster than tyres can make it"),
    ("STEERING", "the steering angle does not follow from the steering rate"),
    ("ELSEWHERE", "the states agree with each other again, but not with where the car must be"),
)
"""Why a measured state is not believed, from 0 on: name, meaning; see br_monitor.c."""

BRAKING_ROWS: Final = 192
"""Most rows of a braking plan."""

RECEPTIONS: Final = (
    ("NEW", "it is now the newest one"),
    ("STALE", "older than one before"),
    ("FOREIGN", "of another plant or run, or far ahead"),
)
"""What became of a state that has arrived, from 0 on: name, meaning."""

COMPENSATIONS: Final = (
    ("OFF", "the state is taken as it is"),
    ("MEASURED", "over the delay that the plant measures"),
    ("FIXED", "over the delay of the settings"),
)
"""Modes of the delay compensation, from 0 on: name, meaning."""

DELAYS: Final = 64
"""Most measured delays that come with one state."""

ENVIRONMENT: Final = (
    ("speed_limit_mps", "double", "the reference moves along the line at most this fast"),
    ("speed_limit_rate_mps2", "double", "by how much the limit falls along the horizon"),
)
"""What a step takes into account beside the car's own state: name, type, meaning.

With infinity and 0 nothing is limited."""

MEASURED: Final = (
    ("epoch", "int64", "random number of the plant's process"),
    ("run", "int64", "number of the run"),
    ("seq", "int64", "number of the state among those of its plant"),
    ("time_s", "double", "plant time since the start of the run"),
    ("x", "states", "as measured"),
    ("u_applied", "inputs", "acted during the period before"),
    ("averaged", "int", "1: that is their mean; 0: it is what acts now, as far as that is known"),
    ("lockstep", "int", "1: the plant waits for the answer"),
    ("delays", "int", "how many delays follow"),
    ("delays_s", "delays", "from the decision on an input to its acting, since the last state"),
)
"""A state as a controller receives it: name, type, meaning."""

DRIVING: Final = (
    ("u_low", "inputs", "what no input is below"),
    ("u_high", "inputs", "what no input is above"),
    ("brake_fade_mps", "double", "speed below which braking fades to none at standstill"),
    ("brake_d", "double", "drive command of braking, turned positive"),
    ("brake_slow", "double", "what is added to it, times the squared speed"),
    ("standing_mps", "double", "a car that is not faster stands"),
    ("stop_mps2", "double", "deceleration of a stop on command"),
    ("shifted_s", "double", "how long after its first input a plan may be driven"),
    ("limit_tolerance", "double", "excess over a limit that is clipped, not refused"),
    ("recover_cycles", "int", "usable solutions in a row that end braking"),
    ("compensation", "int", "br_compensation"),
    ("delay_s", "double", "the fixed one"),
    ("longest_s", "double", "no prediction goes farther"),
    ("stale_s", "double", "age from which a state is fallen back from"),
    ("sensor_tolerance", "double", "multiple of the bounds of br_monitor.c; 0: no monitor"),
)
"""Settings of the control cycle: name, type, meaning."""

SOLUTION: Final = (
    ("u", "inputs", "first input of the plan"),
    ("rows", "int", "of the plan; 0: none"),
    ("plan_u", "plan", "planned inputs"),
    ("plan_step_s", "double", "time from one row of the plan to the next"),
    ("second_start", "int", "as in br_mpc_info"),
    ("cost", "double", "of the plan; -1: not known"),
    ("shifted_cost", "double", "of the plan before, shifted; -1: there was none"),
)
"""What a controller's step hands out: name, type, meaning."""

DECISION: Final = (
    ("u", "inputs", "to be sent: finite, and within the limits"),
    ("status", "int", "of the step, 0: usable; or why there was none"),
    ("level", "int", "of the fallback"),
    ("stepped", "int", "1: a step has been made"),
    ("error", "int", "br_mpc_error of a step that is broken"),
    ("epoch", "int64", "of the state that this answers"),
    ("run", "int64", "of that state"),
    ("seq", "int64", "of that state"),
    ("decided_at_s", "double", "plant time when the cycle began"),
    ("delay_s", "double", "prediction from there to the moment of acting"),
    ("step_us", "double", "execution time of the step; 0 without a clock"),
    ("late_s", "double", "how much later than its budget it was made; not above 0: in time"),
    ("fault", "int", "br_fault of that state"),
)
"""What one cycle decides: name, type, meaning."""

BRAKING: Final = (
    ("rows", "int", "of the plan"),
    ("begins_s", "double", "plant time from which the first row acts"),
    ("step_s", "double", "time from one row to the next"),
    ("duty", "braking", "drive command of each row"),
    ("delta_rad", "braking", "steering angle at its end"),
)
"""What the car's guard does if nothing more comes: name, type, meaning."""

COUNTERS: Final = (
    ("levels", "levels", "cycles by level of the fallback; those on command are not among them"),
    ("failed", "int64", "steps that were broken"),
    ("second_starts", "int64", "steps that looked for another plan"),
    ("cost_jumps", "int64", "steps whose plan costs much more than to go on with the one before"),
    ("stale", "int64", "states of the current run that were not newer than one before"),
    ("foreign", "int64", "states of another plant or run, or far ahead, that were not driven on"),
    ("faults", "faults", "states by what speaks against them"),
    ("fault", "int", "br_fault of the newest state"),
    ("phase", "int", "life cycle of the controller, at this moment"),
    ("delay_s", "double", "delay that is compensated, at this moment"),
    ("interval_s", "double", "plant time between two states in a row; 0: not known"),
)
"""What a control cycle has counted: name, type, meaning."""

SAMPLES: Final = 512
"""Samples of what the car has done that a controller keeps."""

WATCHED: Final = 100
"""The newest of these, on which weights are compared while they are watched."""

WATCH: Final = (
    ("samples", "int", "of the newest, judged so far"),
    ("fresh", "double", "samples since the weights in use were adopted"),
    ("in_use", "outputs", "root mean square error of the weights in use, per stage"),
    ("proven", "outputs", "of the proven weights"),
    ("nominal", "outputs", "of the model without correction"),
)
"""How weights do beside others: name, type, meaning."""

_FUNCTIONS: Final = 12
"""Version of the functions in the public headers: increase it with each change of a signature."""

_TABLES: Final = (
    SOLVER, INFO, STATUSES, ERRORS, INSTRUCTIONS, NO_STEP, LEVELS, PHASES, RECEPTIONS,
    COMPENSATIONS, FAULTS, DELAYS, ENVIRONMENT, MEASURED, DRIVING, SOLUTION, DECISION, BRAKING,
    BRAKING_ROWS, COUNTERS, SAMPLES, WATCHED, WATCH, _FUNCTIONS,
)  # fmt: skip

ABI: Final = zlib.crc32(repr(_TABLES).encode()) & 0x7FFFFFFF
"""Number of the interface: library and binding must have the same."""

_ARRAYS: Final = {
    "states": ("double", "BR_NX"),
    "inputs": ("double", "BR_NU"),
    "plan": ("double", "BR_N * BR_NU"),
    "delays": ("double", str(DELAYS)),
    "levels": ("int64_t", str(len(LEVELS))),
    "faults": ("int64_t", str(len(FAULTS))),
    "braking": ("double", str(BRAKING_ROWS)),
    "outputs": ("double", "BR_NE"),
}


def _numbered(table: Iterable[tuple[str, str]]) -> list[tuple[str, int, str]]:
    return [(name, n, text) for n, (name, text) in enumerate(table)]


def _enum(prefix: str, table: Iterable[tuple[str, int, str]], name: str) -> list[str]:
    return [
        "typedef enum {",
        *(f"    BR_{prefix}{one} = {number}, /* {text} */" for one, number, text in table),
        f"}} {name};",
    ]


def c_fields(table: Iterable[tuple[str, ...]]) -> list[str]:
    """The members of a structure in C, a line each."""
    lines = []
    for field, kind, text, *_ in table:
        element, size = _ARRAYS.get(kind, (kind.replace("int64", "int64_t"), ""))
        lines.append(f"    {element} {field}{f'[{size}]' if size else ''}; /* {text} */")
    return lines


def _struct(table: Iterable[tuple[str, ...]], name: str) -> list[str]:
    return ["typedef struct {", *c_fields(table), f"}} {name};"]


def _each(table: Iterable[tuple[str, ...]]) -> str:
    """The numbers of a structure, arrays left out, as arguments of one of two macros."""
    macros = {"double": "REAL", "int": "WHOLE"}
    return " ".join(f"{macros[kind]}({name})" for name, kind, *_ in table if kind in macros)


def c_interface() -> str:
    """The content of br_interface.h; it follows br_config.h and br_problem.h."""
    statuses = [(name, n, why) for n, (name, _, why) in enumerate(STATUSES)]
    return "\n".join([
        "/* generated from bayesrace/native_interface.py */",
        "#ifndef BR_INTERFACE_H",
        "#define BR_INTERFACE_H",
        "#include <stdint.h>",
        f"#define BR_ABI {ABI}",
        f"#define BR_DELAYS {DELAYS}",
        f"#define BR_BRAKING_ROWS {BRAKING_ROWS}",
        f"#define BR_SAMPLES {SAMPLES}",
        f"#define BR_WATCHED {WATCHED}",
        *_enum("", _numbered(ERRORS), "br_mpc_error"),
        *_enum("", statuses, "br_mpc_status"),
        *_enum("", _numbered(INSTRUCTIONS), "br_instructions"),
        *_enum("", NO_STEP, "br_no_step"),
        *_enum("", _numbered(LEVELS), "br_level"),
        *_enum("FAULT_", _numbered(FAULTS), "br_fault"),
        *_enum("PHASE_", _numbered(PHASES), "br_phase"),
        *_enum("STATE_", _numbered(RECEPTIONS), "br_reception"),
        *_enum("COMPENSATION_", _numbered(COMPENSATIONS), "br_compensation"),
        *_struct(INFO, "br_mpc_info"),
        *_struct(ENVIRONMENT, "br_environment"),
        *_struct(MEASURED, "br_measured"),
        *_struct(DRIVING, "br_driving"),
        *_struct(SOLUTION, "br_solution"),
        *_struct(DECISION, "br_decision"),
        *_struct(BRAKING, "br_braking"),
        *_struct(COUNTERS, "br_counters"),
        *_struct(WATCH, "br_mpc_watch"),
        f"#define BR_SOLVER_FIELDS(REAL, WHOLE) {_each(SOLVER)}",
        f"#define BR_DRIVING_FIELDS(REAL, WHOLE) {_each(DRIVING)}",
        f"#define BR_SOLVER_VALID(p) ({' && '.join(f'(p)->{n} {r}' for n, _, _, r in SOLVER)})",
        "#define BR_ERROR_TEXTS { \\",
        *(f'    "{text}", \\' for _, text in ERRORS),
        "}",
        "#define BR_STATUS_TEXTS { \\",
        *(f'    "{text}", \\' for _, text, _ in STATUSES),
        "}",
        "#endif",
        "",
    ])  # fmt: skip
