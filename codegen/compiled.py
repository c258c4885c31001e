"""A CasADi function compiled to machine code that gives the same bits as CasADi's interpreter."""

import logging
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bayesrace.cache import cache_folder, digest, kept, software
from bayesrace.cpu import cpu_identity
from bayesrace.errors import InputError
from bayesrace.manifest import check_owner
from codegen.compiler import find_compiler

if TYPE_CHECKING:
    import casadi as ca

__all__ = ["compiled"]

_log = logging.getLogger(__name__)

_FLAGS: Final = ("-std=gnu11", "-O2", "-march=native", "-ffp-contract=off", "-fPIC", "-Wall")
"""Without contraction to fused multiply-add: each operation rounds as the interpreter's does."""


def compiled(function: "ca.Function") -> "ca.Function":
    """The same function from a library in the cache, which is made if it is not there.

    The function itself where that cannot be, for want of a C compiler above all; a warning in the
    log says so. Raises CompileError with the compiler's own words.
    """
    import casadi as ca

    parts = (function.serialize(), *_FLAGS, cpu_identity(), *software((), ("casadi",)))
    path = cache_folder() / f"{function.name()}-{digest(parts)}.so"

    def make(partial: Path) -> None:
        compiler = find_compiler()
        generator = ca.CodeGenerator(f"{function.name()}.c")
        generator.add(function)
        with tempfile.TemporaryDirectory() as folder:
            generator.generate(f"{folder}/")
            source = Path(folder) / f"{function.name()}.c"
            compiler.shared_library([source], [], [], partial, _FLAGS, f"{function.name()}*")

    def read(library: Path) -> "ca.Function":
        try:
            check_owner(library)
            return ca.external(function.name(), str(library))
        except (OSError, RuntimeError) as error:
            raise InputError(f"{library} cannot be loaded ({error}): remove it") from None

    try:
        return kept(path, make, read)
    except InputError as error:
        _log.warning("CasADi interprets '%s', which takes longer: %s", function.name(), error)
        return function
