"""The tables that the controller's C and its Python binding share, written down once.

``codegen`` writes them as C (br_interface.h), ``controller`` as ctypes. What depends on the
problem (sizes, parameters) is in each artefact's manifest instead.
"""

import zlib
from typing import Final

__all__ = ["ABI", "ERRORS", "INFO", "SOLVER", "STATUSES", "c_interface"]

SOLVER: Final = (
    ("tolerance", "double", "of the scaled KKT residual for BR_CONVERGED"),
    ("defect_max", "double", "largest dynamics defect of an acceptable plan"),
    (
        "settle",
        "double",
        "a step ends at this stationarity and tenth of the defect, or earlier: see br_step.c",
    ),
    (
        "iterations",
        "int",
        "SQP iterations a step without budget may use, once the defect is below 0.01",
    ),
    (
        "iterations_cold",
        "int",
        "the same for the first step after a reset; with a budget the larger limits every step",
    ),
)
"""Settings of the solver: name, type, meaning. They follow the problem's parameters."""

INFO: Final = (
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
)
"""What is wrong with a call, from 0 on: name, text."""

_FUNCTIONS: Final = 6
"""Version of the functions in bayesrace_mpc.h: increase it with each change of a signature."""

ABI: Final = zlib.crc32(repr((SOLVER, INFO, STATUSES, ERRORS, _FUNCTIONS)).encode()) & 0x7FFFFFFF
"""Number of the interface: library and binding must have the same."""


def c_interface() -> str:
    """The content of br_interface.h."""
    return "\n".join([
        "/* generated from bayesrace/native_interface.py */",
        "#ifndef BR_INTERFACE_H",
        "#define BR_INTERFACE_H",
        f"#define BR_ABI {ABI}",
        "typedef enum {",
        *(f"    BR_{name} = {n}, /* {text} */" for n, (name, text) in enumerate(ERRORS)),
        "} br_mpc_error;",
        "typedef enum {",
        *(f"    BR_{name} = {n}, /* {why} */" for n, (name, _, why) in enumerate(STATUSES)),
        "} br_mpc_status;",
        "typedef struct {",
        *(f"    {kind} {name}; /* {text} */" for name, kind, text in INFO),
        "} br_mpc_info;",
        "#define BR_SOLVER_SETTINGS \\",
        *(f"    {kind} {name}; /* {text} */ \\" for name, kind, text in SOLVER),
        "",
        "#define BR_ERROR_TEXTS { \\",
        *(f'    "{text}", \\' for _, text in ERRORS),
        "}",
        "#define BR_STATUS_TEXTS { \\",
        *(f'    "{text}", \\' for _, text, _ in STATUSES),
        "}",
        "#endif",
        "",
    ])  # fmt: skip
