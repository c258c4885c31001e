"""The native library as ctypes sees it: structures, status codes, argument types.

Made from the same tables as the C: :mod:`bayesrace.native_interface`, and the artefact's manifest.
"""

import ctypes as ct
import struct
from collections import namedtuple
from collections.abc import Iterable, Mapping
from enum import IntEnum
from mmap import ACCESS_COPY, mmap
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.manifest import Manifest, ProblemInfo, check_library, read_manifest
from bayesrace.native_interface import (
    ABI,
    BRAKING,
    BRAKING_ROWS,
    COUNTERS,
    DECISION,
    DELAYS,
    DRIVING,
    ENVIRONMENT,
    FAULTS,
    INFO,
    LEVELS,
    MEASURED,
    SOLUTION,
    SOLVER,
    STATUSES,
    WATCH,
)

__all__ = [
    "Artefact",
    "EnvironmentStructure",
    "Gp",
    "Layout",
    "StepInfo",
    "StepStatus",
    "aligned_memory",
    "parameters_type",
]


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


_TYPES: Final[dict[str, Any]] = {
    "double": ct.c_double,
    "int": ct.c_int,
    "int64": ct.c_int64,
    "delays": ct.c_double * DELAYS,
    "levels": ct.c_int64 * len(LEVELS),
    "faults": ct.c_int64 * len(FAULTS),
    "braking": ct.c_double * BRAKING_ROWS,
}


def _fields(
    table: Iterable[tuple[str, ...]], sized: Mapping[str, Any] = _TYPES
) -> list[tuple[str, Any]]:
    return [(name, sized[kind]) for name, kind, *_ in table]


def parameters_type(problem: ProblemInfo) -> type[ct.Structure]:
    """br_mpc_parameters: the problem's run-time parameters, then the settings of the solver."""
    own = [(one.name, ct.c_double) for one in problem.parameters]
    return type("Parameters", (ct.Structure,), {"_fields_": [*own, *_fields(SOLVER)]})


_CODES: Final = {ct.c_int: "i", ct.c_int64: "q", ct.c_double: "d"}


class Layout:
    """The fields of a structure up to ``last``, to be read or written all at once.

    The numbers of an array ``u`` follow each other, as ``u0``, ``u1`` and so on. Field by field,
    ctypes takes ten times as long.
    """

    def __init__(self, structure: type[ct.Structure], last: str) -> None:
        codes, names = "@", []
        fields: Any = structure._fields_
        for name, kind in fields:
            length = getattr(kind, "_length_", None)
            codes += _CODES[kind] if length is None else f"{length}{_CODES[kind._type_]}"
            names += [name] if length is None else [f"{name}{i}" for i in range(length)]
            if name == last:
                break
        form = struct.Struct(codes)
        self.write: Final = form.pack_into
        """(memory, 0, a value for each field)."""
        make: Any = namedtuple
        self._unpack, self._named = form.unpack_from, make("Values", names)._make

    def read(self, memory: ct.Structure) -> Any:
        """The values, by name."""
        return self._named(self._unpack(memory))


def aligned_memory(size: int) -> tuple[Any, ct.c_void_p]:
    """A block for an object of the library, zeros, and its address.

    Of pages of its own: those that nobody writes, as for weights of more points, take no memory.
    """
    block = (ct.c_char * size).from_buffer(mmap(-1, size, access=ACCESS_COPY))
    return block, ct.c_void_p(ct.addressof(block))


class Gp(ct.Structure):
    """br_mpc_gp: one output's weights."""

    _fields_ = [
        ("kernel", ct.c_int),
        ("n", ct.c_int),
        ("offset", ct.c_double),
        ("scale", ct.c_double),
        ("signal", ct.c_double),
        ("noise", ct.c_double),
        ("length_scales", ct.c_void_p),
        ("inputs", ct.c_void_p),
        ("alpha", ct.c_void_p),
    ]


class EnvironmentStructure(ct.Structure):
    """br_environment, in the order of :class:`controller.interface.Environment`."""

    _fields_ = _fields(ENVIRONMENT)


class StepInfo(ct.Structure):
    """br_mpc_info: residuals at the returned plan, cost, and the car's place on the line.

    What each field means: :data:`bayesrace.native_interface.INFO`.
    """

    _fields_ = _fields(INFO)
    status: int
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
    tube_m: float
    pace: float
    widening: float
    s_ref_m: float
    lateral_m: float


class Artefact:
    """A compiled problem: its manifest, its library, and the structures of its size.

    The structures are those of :mod:`bayesrace.native_interface`: ``Measured``, ``Driving``,
    ``Solution``, ``Decision``, ``Braking``, ``Counters``, ``Watch``.
    """

    def __init__(self, folder: Path) -> None:
        """InputError if it cannot be used here."""
        self.manifest = read_manifest(folder)
        self.library = _load(folder, self.manifest)
        nx, nu = len(self.manifest.problem.states), len(self.manifest.problem.inputs)
        sized = {
            **_TYPES,
            "states": ct.c_double * nx,
            "inputs": ct.c_double * nu,
            "plan": ct.c_double * (nu * self.manifest.horizon),
            "outputs": ct.c_double * self.manifest.problem.outputs,
        }
        for name, table in _STRUCTURES.items():
            made = type(name, (ct.Structure,), {"_fields_": _fields(table, sized)})
            setattr(self, name, made)

    Measured: Any
    Driving: Any
    Solution: Any
    Decision: Any
    Braking: Any
    Counters: Any
    Watch: Any

    def check_cycle(self) -> None:
        """InputError if it has no control cycle: its problem does not follow a path."""
        if not hasattr(self.library, "br_cycle_init"):
            raise InputError(
                f"problem '{self.manifest.problem.name}' drives no car: run 'bayesrace build'"
            )

    def check(self, error: int, what: str) -> None:
        """InputError with the library's words, if there is an error."""
        if error:
            text = self.library.br_mpc_error_text(error).decode()
            raise InputError(f"native controller, {what}: {text}")


_STRUCTURES: Final = {
    "Measured": MEASURED,
    "Driving": DRIVING,
    "Solution": SOLUTION,
    "Decision": DECISION,
    "Braking": BRAKING,
    "Counters": COUNTERS,
    "Watch": WATCH,
}


def _load(artefact: Path, manifest: Manifest) -> ct.CDLL:
    """The artefact's library with its functions' types; InputError if it cannot be used here."""
    path = check_library(artefact, manifest)
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
    pointer, real, whole = ct.c_void_p, ct.c_double, ct.c_int
    arguments: dict[str, list[Any]] = {
        "mpc_init": [pointer, ct.c_size_t, pointer],
        "mpc_set_parameters": [pointer] * 2,
        "mpc_set_path": [pointer, pointer, whole, real],
        "mpc_set_weights": [pointer] * 2,
        "mpc_stage_weights": [pointer] * 2,
        "mpc_get_samples": [pointer] * 4,
        "mpc_set_clock": [pointer] * 3,
        "mpc_reset": [pointer],
        "mpc_step": [*[pointer] * 4, real, real, *[pointer] * 3],
        "mpc_solve": [*[pointer] * 3, real, real, *[pointer] * 4],
        "mpc_observe": [pointer, pointer, pointer, real, pointer],
        "mpc_prepare": [pointer, real, real],
        "mpc_rehearse": [pointer],
        "mpc_predict": [pointer, pointer, pointer, real, pointer],
        "mpc_get_plan": [pointer] * 3,
        "mpc_get_reference": [pointer] * 2,
        "mpc_get_tube": [pointer] * 2,
        "mpc_variance": [pointer] * 3,
        "mpc_evaluate": [pointer] * 6,
        "mpc_set_instructions": [pointer, whole],
        "mpc_get_instructions": [pointer],
        "mpc_memory_size": [],
        "mpc_error_text": [whole],
        "mpc_status_text": [whole],
    }
    of_cycles: dict[str, list[Any]] = {
        "cycle_memory_size": [],
        "cycle_init": [pointer, ct.c_size_t, pointer, whole, pointer],
        "cycle_drive_mpc": [pointer, ct.c_size_t, pointer, whole, pointer],
        "cycle_info": [pointer],
        "cycle_set_driving": [pointer] * 2,
        "cycle_set_clock": [pointer] * 3,
        "cycle_observe": [pointer] * 2,
        "cycle_decide": [pointer, pointer, *[real] * 3, pointer],
        "cycle_prepare": [pointer, real, real],
        "cycle_brake": [pointer] * 2,
        "cycle_counters": [pointer],
        **{f"cycle_{name}": [pointer] for name in ("rehearse", "stop", "go", "end", "forget")},
    }
    if hasattr(library, "br_cycle_init"):  # of a problem that follows a path
        arguments |= of_cycles
    for name, types in arguments.items():
        function = getattr(library, f"br_{name}")
        function.argtypes = types
        function.restype = _RETURNS.get(name, whole)


_RETURNS: Final[dict[str, Any]] = {
    **dict.fromkeys(("mpc_memory_size", "cycle_memory_size"), ct.c_size_t),
    **dict.fromkeys(("mpc_error_text", "mpc_status_text"), ct.c_char_p),
    **dict.fromkeys(("cycle_info", "cycle_counters"), ct.c_void_p),
    **dict.fromkeys(("mpc_reset", "cycle_prepare", "cycle_rehearse"), None),
    **dict.fromkeys(("cycle_stop", "cycle_go", "cycle_end"), None),
}
