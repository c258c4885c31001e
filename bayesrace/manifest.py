"""What a built controller is: codegen writes it, every program that loads the library reads it.

The manifest names everything that shaped the artefact. Weights learned for another model, step
or scheme are refused by comparing :attr:`Manifest.discretisation`.
"""

import hashlib
import os
import re
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final

from pydantic import Field, ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole
from bayesrace.strict import StrictModel
from bayesrace.trusted_files import trusted
from bayesrace.vehicles.parameters import Car

__all__ = [
    "DECLARATIONS",
    "LIBRARY",
    "MANIFEST",
    "Manifest",
    "ParameterInfo",
    "ProblemInfo",
    "interface_version",
    "opened_library",
    "read_manifest",
    "runs_here",
]

LIBRARY: Final = "libmpc.so"
DECLARATIONS: Final = "libmpc_interface.py"
"""What the headers of the library declare, as cffi reads it fastest."""
MANIFEST: Final = "manifest.json"
_HEADERS: Final = tuple(
    Path(__file__).parent / "controller" / "native" / name
    for name in ("bayesrace_mpc.h", "bayesrace_cycle.h")
)


class ParameterInfo(StrictModel):
    """One run-time parameter of a problem."""

    name: str
    unit: str
    text: str
    low: float
    high: float
    positive: bool = Field(description="has to be above zero")


class ProblemInfo(StrictModel):
    """The control problem, as far as its users need it; codegen/problems/ describes it."""

    name: str
    states: list[str]
    inputs: list[str]
    stage_parameters: list[str]
    parameters: list[ParameterInfo] = Field(description="in the order of br_mpc_parameters")
    features: list[str] = Field(description="of the residual")
    outputs: int = Field(description="of the residual")
    follows_path: bool = Field(False, description="whether it drives a car along a line")


class Manifest(StrictModel):
    """Identity of one built controller."""

    abi: int = Field(description="version of the C interface")
    problem: ProblemInfo
    model: str = Field(description="vehicle model the OCP predicts with")
    car: str
    car_digest: str = Field(description="identity of the car's parameters")
    discretisation: str = Field(description="identity of model, scheme, step and car")
    horizon: int = Field(gt=0, description="stages N")
    step_s: float = Field(gt=0, description="sampling time Ts")
    gp_capacity: int = Field(gt=0, description="training points per output that fit")
    path_rows: int = Field(gt=0, description="rows of the line's table that fit")
    weight_buffers: int = Field(description="3, or 1: weights are set at the start only")
    estimator: bool = Field(description="states are estimated of what instruments measure")
    casadi: str
    compiler: str
    flags: list[str]
    build_hash: str = Field(description="hash of everything that shaped the artefact")
    library_sha256: str
    interface_sha256: str

    def check_car(self, car: Car, artefact: Path) -> None:
        """InputError if this artefact was built for another car, or solves another problem."""
        if not self.problem.follows_path:
            raise InputError(
                f"{artefact} solves the problem '{self.problem.name}', which drives no car: run "
                "'bayesrace build'"
            )
        if (self.car, self.car_digest) != (car.name, car.digest()):
            raise InputError(
                f"{artefact} was built for car '{self.car}-{self.car_digest}', not "
                f"'{car.name}-{car.digest()}': run 'bayesrace build'"
            )
        if car.sensors.root and not self.estimator:
            raise InputError(
                f"{artefact} has no estimator, which car '{car.name}' with its sensors needs: run "
                "'bayesrace build' without --no-estimator"
            )

    def check_points(self, points: int) -> None:
        """InputError if GPs of so many points do not fit into this controller."""
        if points > self.gp_capacity:
            raise InputError(
                f"--points {points} are more than this controller has room for "
                f"({self.gp_capacity}); give fewer, or build one with --gp-capacity"
            )

    def check_rows(self, rows: int) -> None:
        """InputError if a line's table of so many rows does not fit into this controller."""
        if rows > self.path_rows:
            raise InputError(
                f"a racing line of {rows} rows is longer than this controller has room for "
                f"({self.path_rows}): build one with --path-rows {rows}"
            )


@cache
def interface_version() -> int:
    """Number of the C interface: a hash of what its headers declare, comments left out."""
    text = " ".join(path.read_text() for path in _HEADERS)
    code = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)
    return zlib.crc32(" ".join(code.split()).encode()) & 0x7FFFFFFF


def read_manifest(artefact: Path) -> Manifest:
    """Manifest of the artefact folder; InputError if it is not one, belongs to another ABI, or
    other users could have put it there."""
    path = artefact / MANIFEST
    if not os.access(path, os.F_OK):  # where that may not be looked at, it is none either
        raise InputError(
            f"{artefact} is not a built controller (no {MANIFEST}): run 'bayesrace build'"
        )
    try:
        manifest = Manifest.model_validate_json(read_whole(trusted(path), "the manifest"))
    except ValidationError as error:
        raise InputError(
            f"{path} is no manifest ({faults_in(error)}): run 'bayesrace build'"
        ) from None
    if manifest.abi != interface_version():
        raise InputError(
            f"{path} was built for interface {manifest.abi}, this program has "
            f"{interface_version()}: run 'bayesrace build'"
        )
    return manifest


def runs_here(artefact: Path) -> bool:
    """Whether its library is for a processor like this one: its ELF header names the machine that
    the interpreter's own does."""
    try:
        library, interpreter = map(_head, (artefact / LIBRARY, Path(sys.executable)))
    except OSError:
        return False
    return library[:4] == b"\x7fELF" and library[18:] == interpreter[18:]


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(20)


@contextmanager
def opened_library(artefact: Path, manifest: Manifest) -> Iterator[tuple[bytes, BinaryIO]]:
    """Declarations of the artefact, and its opened library: code that may be executed.

    InputError if they are not those that the manifest describes, or other users could have put them
    there; see :func:`bayesrace.trusted_files.trusted`.
    """
    with (
        _opened(artefact / DECLARATIONS, manifest.interface_sha256) as declarations,
        _opened(artefact / LIBRARY, manifest.library_sha256) as library,
    ):
        yield declarations.read(), library


@contextmanager
def _opened(path: Path, sha256: str) -> Iterator[BinaryIO]:
    try:
        file = trusted(path).open("rb")
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror or error}): run 'bayesrace build'"
        ) from None
    with file:
        if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
            raise InputError(
                f"{path} is not the file its manifest describes: run 'bayesrace build'"
            )
        file.seek(0)
        yield file
