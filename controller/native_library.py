"""The native library as ctypes sees it: structures, status codes, argument types.

Made from the same tables as the C: :mod:`bayesrace.native_interface`, and the artefact's manifest.
"""

import ctypes as ct
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from bayesrace.cpu import cpu_digest
from bayesrace.errors import InputError
from bayesrace.manifest import Manifest, ProblemInfo, check_library
from bayesrace.native_interface import ABI, INFO, SOLVER, STATUSES

__all__ = ["Gp", "StepInfo", "StepStatus", "load_library", "parameters_type"]


class StepStatus(IntEnum):
    """What became of the optimisation problem; see :data:`bayesrace.native_interface.STATUSES`."""

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
        return STATUSES[self][1]


_TYPES: Final[dict[str, Any]] = {"double": ct.c_double, "int": ct.c_int}


def _fields(table: Iterable[tuple[str, str, str]]) -> list[tuple[str, Any]]:
    return [(name, _TYPES[kind]) for name, kind, _ in table]


def parameters_type(problem: ProblemInfo) -> type[ct.Structure]:
    """br_mpc_parameters: the problem's run-time parameters, then the settings of the solver."""
    own = [(one.name, ct.c_double) for one in problem.parameters]
    return type("Parameters", (ct.Structure,), {"_fields_": [*own, *_fields(SOLVER)]})


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
    """br_mpc_info: residuals at the returned plan, cost, and the car's place on the line.

    What each field means: :data:`bayesrace.native_interface.INFO`.
    """

    _fields_ = _fields(INFO)
    iterations: int
    qp_iterations: int
    regularised: int
    shortened: int
    second_start: int
    shifts: int
    prepared: int
    prepared_iterations: int
    time_limited: int
    stationarity: float
    defect: float
    bound: float
    shifted_cost: float
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
        "step": [*[pointer] * 3, real, real, *[pointer] * 3],
        "solve": [*[pointer] * 3, real, real, *[pointer] * 4],
        "prepare": [pointer, real, real],
        "rehearse": [pointer],
        "predict": [pointer, pointer, pointer, real, pointer],
        "get_plan": [pointer] * 3,
        "get_reference": [pointer] * 2,
        "evaluate": [pointer] * 6,
    }
    for name, types in arguments.items():
        getattr(library, f"br_mpc_{name}").argtypes = types
