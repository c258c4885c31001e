"""A built controller as cffi sees it: its library, and the structures that its header declares."""

import runpy
from enum import IntEnum
from mmap import ACCESS_COPY, mmap
from pathlib import Path
from typing import Any

from bayesrace.errors import InputError
from bayesrace.manifest import DECLARATIONS, check_library, read_manifest

__all__ = ["Artefact", "StepStatus"]


class StepStatus(IntEnum):
    """What became of the optimisation problem: br_mpc_status in controller/native/bayesrace_mpc.h,
    which says what each means."""

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


class Artefact:
    """A built controller: its manifest, its library, and ``ffi`` with the types of its header.

    The functions of ``library`` release the interpreter's lock while they run.
    """

    def __init__(self, folder: Path) -> None:
        """InputError if it cannot be used here."""
        self.manifest = read_manifest(folder)
        self.path = check_library(folder, self.manifest)
        self.ffi: Any = runpy.run_path(str(folder / DECLARATIONS))["ffi"]
        try:
            self.library: Any = self.ffi.dlopen(str(self.path))
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be loaded here ({error}): it was built for another machine, "
                "or its file system allows no programs (noexec); remove the folder and run "
                "'bayesrace build', with BAYESRACE_CACHE set to another folder if need be"
            ) from None

    def memory(self, size: int) -> Any:
        """A block for an object of the library, zeros.

        Of pages of its own: those that nobody writes, as for weights of more points, take no
        memory.
        """
        return self.ffi.from_buffer(mmap(-1, size, access=ACCESS_COPY))

    def check_cycle(self) -> None:
        """InputError if it has no control cycle: its problem does not follow a path."""
        if not hasattr(self.library, "br_cycle_init"):
            raise InputError(
                f"problem '{self.manifest.problem.name}' drives no car: run 'bayesrace build'"
            )

    def check(self, error: int, what: str) -> None:
        """InputError with the library's words, if there is an error."""
        if error:
            text = self.text(self.library.br_mpc_error_text(error))
            raise InputError(f"native controller, {what}: {text}")

    def text(self, characters: Any) -> str:
        """A string of the library's."""
        return str(self.ffi.string(characters).decode())
