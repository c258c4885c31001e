"""The native library as ctypes sees it: structures, status codes, argument types.

Mirrors controller/native/bayesrace_mpc.h; :data:`bayesrace.manifest.ABI` says which version.
"""

import ctypes as ct
from enum import IntEnum
from pathlib import Path
from typing import Final

from bayesrace.cpu import cpu_digest
from bayesrace.errors import InputError
from bayesrace.manifest import ABI, Manifest, check_library

__all__ = ["Gp", "Parameters", "StepInfo", "StepStatus", "load_library"]


class StepStatus(IntEnum):
    """br_mpc_status: what became of the optimisation problem."""

    CONVERGED = 0
    ACCEPTABLE = 1
    DEFECT = 2
    INFEASIBLE = 3
    QP_LIMIT = 4
    NOT_FINITE = 5
    BAD_STATE = 6
    TIME_LIMIT = 7

    @property
    def usable(self) -> bool:
        """Whether the first input may go to the actuators."""
        return self <= StepStatus.ACCEPTABLE

    @property
    def text(self) -> str:
        """As br_mpc_status_text has it."""
        return _STATUS_TEXT[self]


_STATUS_TEXT: Final = {
    StepStatus.CONVERGED: "converged",
    StepStatus.ACCEPTABLE: "acceptable",
    StepStatus.DEFECT: "dynamics defect too large",
    StepStatus.INFEASIBLE: "QP infeasible",
    StepStatus.QP_LIMIT: "QP iteration limit",
    StepStatus.NOT_FINITE: "not finite",
    StepStatus.BAD_STATE: "bad state",
    StepStatus.TIME_LIMIT: "out of time before the plan was usable",
}
"""For those who hold a status but no library; a test compares."""


class Parameters(ct.Structure):
    """br_mpc_parameters."""

    _fields_ = [
        *(
            (name, ct.c_double)
            for name in (
                "q_position",
                "r_duty",
                "r_delta_rate",
                "s_slack",
                "margin_m",
                "d_min",
                "d_max",
                "delta_max_rad",
                "delta_rate_max_radps",
                "tolerance",
                "defect_max",
                "settle",
            )
        ),
        ("iterations", ct.c_int),
        ("iterations_cold", ct.c_int),
    ]


class Gp(ct.Structure):
    """br_mpc_gp: one output's weights."""

    _fields_ = [
        ("kernel", ct.c_int),
        ("n", ct.c_int),
        ("offset", ct.c_double),
        ("scale", ct.c_double),
        ("length_scales", ct.c_void_p),
        ("inputs", ct.c_void_p),
        ("alpha", ct.c_void_p),
    ]


class StepInfo(ct.Structure):
    """br_mpc_info: residuals at the returned plan, cost, and the car's place on the line."""

    _fields_ = [
        ("iterations", ct.c_int),
        ("qp_iterations", ct.c_int),
        ("regularised", ct.c_int),
        ("shortened", ct.c_int),
        ("second_start", ct.c_int),
        ("shifts", ct.c_int),
        ("prepared", ct.c_int),
        ("prepared_iterations", ct.c_int),
        ("time_limited", ct.c_int),
        ("stationarity", ct.c_double),
        ("defect", ct.c_double),
        ("bound", ct.c_double),
        ("shifted_cost", ct.c_double),
        ("cost", ct.c_double),
        ("slack_max_m", ct.c_double),
        ("s_ref_m", ct.c_double),
        ("lateral_m", ct.c_double),
    ]
    iterations: int
    qp_iterations: int
    regularised: int
    shortened: int
    second_start: int
    """1: the plan from before was doubtful, and a new one no better; 2: the new one is better."""
    shifts: int
    """Stages by which the plan before was shifted; -1: there was none."""
    prepared: int
    prepared_iterations: int
    time_limited: int
    stationarity: float
    defect: float
    bound: float
    shifted_cost: float
    """Of the plan before, shifted, under the same reference; 0 cold."""
    cost: float
    slack_max_m: float
    s_ref_m: float
    lateral_m: float


def load_library(artefact: Path, manifest: Manifest) -> ct.CDLL:
    """The artefact's library with its functions' types; InputError if it cannot be used here."""
    path = check_library(artefact, manifest)
    if manifest.cpu != cpu_digest():
        raise InputError(
            f"{path} was compiled for another CPU: remove the folder and run 'bayesrace build' here"
        )
    try:
        library = ct.CDLL(str(path))
    except OSError as error:
        raise InputError(
            f"{path} cannot be loaded here ({error}): it was built for another machine, or its "
            "file system allows no programs (noexec); remove the folder and run 'bayesrace build', "
            "with BAYESRACE_CACHE set to another folder if need be"
        ) from None
    try:
        if library.br_mpc_abi() == ABI:
            _declare(library)
            return library
    except AttributeError as error:
        raise InputError(f"{path} lacks a function ({error}): run 'bayesrace build'") from None
    raise InputError(f"{artefact}: library and manifest disagree: run 'bayesrace build'")


def _declare(library: ct.CDLL) -> None:
    pointer, real = ct.c_void_p, ct.c_double
    library.br_mpc_memory_size.restype = ct.c_size_t
    library.br_mpc_error_text.restype = ct.c_char_p
    library.br_mpc_status_text.restype = ct.c_char_p
    library.br_mpc_reset.restype = None
    arguments: dict[str, list[type]] = {
        "init": [pointer, ct.c_size_t, pointer],
        "set_parameters": [pointer] * 2,
        "set_path": [pointer, pointer, ct.c_int, real],
        "set_weights": [pointer] * 2,
        "stage_weights": [pointer] * 2,
        "set_clock": [pointer] * 3,
        "set_speed_limit": [pointer, ct.c_double, ct.c_double],
        "reset": [pointer],
        "step": [pointer, pointer, real, real, real, *[pointer] * 3],
        "solve": [pointer, pointer, real, real, real, *[pointer] * 4],
        "prepare": [pointer, real, real],
        "rehearse": [pointer],
        "predict": [pointer, pointer, pointer, real, pointer],
        "get_plan": [pointer] * 3,
        "get_reference": [pointer] * 2,
        "evaluate": [pointer] * 6,
    }
    for name, types in arguments.items():
        getattr(library, f"br_mpc_{name}").argtypes = types
