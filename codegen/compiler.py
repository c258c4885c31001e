"""Finds a C compiler; turns C files into a shared library, and a CasADi function into machine code
that gives the same bits as CasADi's interpreter.
"""

import logging
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bayesrace.cache import cache_folder, code_folder, cpu_identity, digest, kept, software
from bayesrace.errors import InputError
from bayesrace.files import temporary_folder
from bayesrace.processes import RUN_MODULE
from bayesrace.trusted_files import make_folder, trusted

if TYPE_CHECKING:
    import casadi as ca

__all__ = [
    "FLAGS", "CompileError", "Compiler", "chosen_command", "compiled", "find_compiler", "version_of"
]  # fmt: skip

FLAGS: Final = (
    "-std=gnu11",
    "-O3",
    "-fPIC",
    "-fvisibility=hidden",
    "-ffp-contract=fast",
    # square roots and comparisons without errno and traps vectorise; NaN checks stay intact,
    # which -ffast-math would delete
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wall",
)

_log = logging.getLogger(__name__)

_EXACT: Final = ("-std=gnu11", "-O2", "-march=native", "-ffp-contract=off", "-fPIC", "-Wall")
"""Without contraction to fused multiply-add: each operation rounds as the interpreter's does."""


class CompileError(RuntimeError):
    """The C compiler failed; the message carries what it printed."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler command and the version it states."""

    command: tuple[str, ...]
    version: str

    def shared_library(
        self,
        sources: list[Path],
        includes: list[Path],
        archives: list[Path],
        out: Path,
        flags: tuple[str, ...] = FLAGS,
        exports: str = "br_mpc_*; br_cycle_*; br_estimator_*",
    ) -> None:
        """Compiles ``sources`` and links them with ``archives``; hides all symbols but ``exports``,
        patterns with semicolons between."""
        with temporary_folder() as folder:
            line: list[str | Path] = ["-shared"]
            if platform.system() == "Linux":
                # A version script instead of --exclude-libs, which zig's linker does not know;
                # -z defs, or a library that lacks a symbol would fail only when it is loaded.
                script = folder / "exports.map"
                script.write_text(f"{{ global: {exports}; local: *; }};\n")
                line += [f"-Wl,--version-script={script}", "-Wl,-z,defs"]
            self._link(sources, includes, archives, out, flags, line, folder)

    def program(
        self, sources: list[Path], includes: list[Path], archives: list[Path], out: Path
    ) -> None:
        """Compiles ``sources`` and links them with ``archives``."""
        with temporary_folder() as folder:
            self._link(sources, includes, archives, out, FLAGS, ["-pthread"], folder)

    def _link(
        self, sources: list[Path], includes: list[Path], archives: list[Path], out: Path,
        flags: tuple[str, ...], how: list[str | Path], folder: Path,
    ) -> None:  # fmt: skip
        objects = self.objects(sources, includes, flags, folder)
        self.run(*flags, *how, *objects, *archives, "-lm", "-o", out)

    def objects(
        self, sources: list[Path], includes: list[Path], flags: tuple[str, ...], folder: Path
    ) -> list[Path]:
        """Compiled, as many at once as there are processors, into an empty folder."""
        seen = [f"-I{path}" for path in includes]
        objects = [folder / f"{source.stem}-{i}.o" for i, source in enumerate(sources)]

        def compile_one(source: Path, target: Path) -> None:
            self.run(*flags, *seen, "-c", source, "-o", target)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(compile_one, sources, objects))  # after a failure no other is begun
        return objects

    def run(self, *arguments: str | Path, folder: Path | None = None) -> str:
        """Runs it in a folder, the current one by default; its output. CompileError with what it
        printed of an error."""
        line = [*self.command, *(str(one) for one in arguments)]
        done = subprocess.run(
            line, cwd=folder, capture_output=True, text=True, errors="replace", check=False
        )
        if done.returncode:
            raise CompileError(f"{shlex.join(line)}\n{_shortened(done.stderr)}")
        return done.stdout


def _shortened(text: str, most: int = 4000) -> str:
    """Beginning, where the first error is, and end, where the linker's are."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}\n[…]\n{text[-most // 2 :]}"


def chosen_command() -> tuple[str, ...]:
    """What ``CC`` names; empty if it names nothing. InputError if that is no command."""
    chosen = os.environ.get("CC", "")
    try:
        return tuple(shlex.split(chosen))
    except ValueError as error:
        raise InputError(f"CC={chosen}: {error}; set it to a command such as 'gcc'") from None


def _candidates(by_name: bool) -> list[tuple[str, ...]]:
    if not by_name and (chosen := chosen_command()):
        return [chosen]
    found: list[tuple[str, ...]] = [
        (name,) for name in ("cc", "gcc", "clang") if shutil.which(name)
    ]
    if find_spec("ziglang"):
        found.append((*RUN_MODULE, "ziglang", "cc"))
    return found


def _can_build(compiler: Compiler) -> None:
    """Raises what a compiler raises that builds no library.

    One that has built one is not asked again: that would take longer than to find a controller in
    the cache.
    """
    proof = cache_folder() / ".compilers" / digest((*compiler.command, compiler.version))
    if proof.exists():
        return
    with tempfile.TemporaryDirectory() as folder:
        probe = Path(folder) / "probe.c"
        probe.write_text("#include <math.h>\nint probe(void) { return 0; }\n")
        _run([*compiler.command, "-shared", "-fPIC", str(probe), "-lm", "-o", f"{probe}.so"])
    with suppress(OSError, InputError):  # the cache says so where it is used
        make_folder(proof.parent)
        proof.touch()


def _run(line: list[str]) -> str:
    done = subprocess.run(
        line, capture_output=True, text=True, errors="replace", check=True, timeout=120
    )
    return done.stdout


def version_of(command: tuple[str, ...]) -> str:
    """What a compiler says of itself."""
    return (_run([*command, "--version"]).splitlines() or ["unknown version"])[0]


@cache
def find_compiler(by_name: bool = False) -> Compiler:
    """$CC, the system's cc, gcc or clang, or ziglang: the first that can build a library.

    ``by_name``: whatever ``CC`` says, which may be for another machine. InputError with the remedy
    if none can.
    """
    tried = []
    for command in _candidates(by_name):
        try:
            compiler = Compiler(command, version_of(command))
            _can_build(compiler)
        except (OSError, subprocess.SubprocessError) as error:
            words = getattr(error, "stderr", "") or str(error)
            tried.append(f"{shlex.join(command)}: {words.strip()[:200]}")
            continue
        return compiler
    details = f" (tried: {'; '.join(tried)})" if tried else ""
    raise InputError(
        f"no C compiler found{details}: install gcc or clang, or 'pip install ziglang'"
    )


def compiled(function: "ca.Function") -> "ca.Function":
    """The same function from a library in the cache, which is made if it is not there.

    The function itself where that cannot be, for want of a C compiler above all; a warning in the
    log says so. Raises CompileError with the compiler's own words.
    """
    import casadi as ca

    parts = (function.serialize(), *_EXACT, cpu_identity(), *software((), ("casadi",)))
    name = f"{function.name()}-{digest(parts)}.so"

    def make(partial: Path) -> None:
        compiler = find_compiler()
        generator = ca.CodeGenerator(f"{function.name()}.c")
        generator.add(function)
        with tempfile.TemporaryDirectory() as folder:
            generator.generate(f"{folder}/")
            source = Path(folder) / f"{function.name()}.c"
            compiler.shared_library([source], [], [], partial, _EXACT, f"{function.name()}*")

    def read(library: Path) -> "ca.Function":
        try:
            return ca.external(function.name(), str(trusted(library)))
        except (OSError, RuntimeError) as error:
            raise InputError(f"{library} cannot be loaded ({error}): remove it") from None

    try:
        return kept(code_folder() / name, make, read)
    except InputError as error:
        _log.warning("CasADi interprets '%s', which takes longer: %s", function.name(), error)
        return function
