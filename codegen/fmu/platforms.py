"""Binaries of an FMU: the host's by its own compiler, others cross-compiled by ziglang."""

import platform
import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.interpreter import RUN_MODULE
from codegen.compiler import CompileError, find_compiler

__all__ = [
    "EXPORTS",
    "FLAGS",
    "PLATFORMS",
    "Platform",
    "arguments",
    "compile_binary",
    "get_platform",
    "host_platform",
]

FLAGS: Final = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fvisibility=hidden")
"""Portable, and the same arithmetic on every platform: no fused multiply-add."""


@dataclass(frozen=True)
class Platform:
    """An operating system and processor that FMI has a folder for."""

    name: str
    """FMI 3.0's folder, and what the command line calls it."""
    fmi2: str
    """FMI 2.0's folder."""
    suffix: str
    zig: str | None
    """ziglang's target; None: only the host's own compiler can build for it."""

    def folder(self, version: int) -> str:
        """Below ``binaries/``."""
        return self.fmi2 if version == 2 else self.name


# the old glibc is for the binary to load on old systems too
PLATFORMS: Final = {
    known.name: known
    for known in (
        Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17"),
        Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
        Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
        Platform("x86_64-darwin", "darwin64", ".dylib", None),
        Platform("aarch64-darwin", "darwin64", ".dylib", None),
    )
}

_ALIASES: Final = {"linux64": "x86_64-linux", "win64": "x86_64-windows"}

_MACHINES: Final = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


def host_platform() -> Platform:
    """The platform this runs on; InputError if FMI has no folder for it."""
    machine = _MACHINES.get(platform.machine().lower(), platform.machine())
    return get_platform(f"{machine}-{platform.system().lower()}")


def get_platform(name: str) -> Platform:
    """By FMI 3.0 name, or linux64 or win64; InputError naming the known ones."""
    try:
        return PLATFORMS[_ALIASES.get(name, name)]
    except KeyError:
        raise InputError(f"unknown platform '{name}'; known: {', '.join(PLATFORMS)}") from None


def _command(target: Platform) -> list[str]:
    if target == host_platform():
        return list(find_compiler().command)
    if target.zig is None:
        raise InputError(f"binaries for {target.name} can only be built on {target.name}")
    if find_spec("ziglang") is None:
        raise InputError(
            f"a binary for {target.name} is cross-compiled with ziglang, which is missing: "
            "'pip install ziglang', or leave this platform out"
        )
    # stripped: what it strips names temporary files, which differ from build to build
    return [*RUN_MODULE, "ziglang", "cc", "-target", target.zig, "-s", "-g0"]


def arguments(
    target: Platform, sources: Sequence[str], out: str, flags: Sequence[str]
) -> list[str]:
    """What follows the compiler's name, in a folder that holds ``sources`` (archives last)."""
    line = [*FLAGS, *flags, "-shared"]
    if target.suffix != ".dll":
        line.append("-fPIC")
    line += ["-I.", *sources, "-lm", "-o", out]
    if target.suffix == ".so":
        # only FMI's own functions, also where archives bring others; and nothing left undefined
        line += ["-Wl,--version-script=exports.map", "-Wl,-z,defs"]
    return line


EXPORTS: Final = "{ global: fmi2*; fmi3*; local: *; };\n"
"""``exports.map`` among the sources."""


def compile_binary(
    target: Platform, folder: Path, sources: Sequence[str], out: Path, flags: Sequence[str]
) -> None:
    """Compiles files in ``folder`` to the shared library ``out``.

    Raises CompileError with the compiler's words, InputError if no compiler serves.
    """
    line = [*_command(target), *arguments(target, sources, str(out), flags)]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CompileError(f"{shlex.join(line)}\n{done.stderr[:4000]}")
