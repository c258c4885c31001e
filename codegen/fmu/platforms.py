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

__all__ = ["FLAGS", "PLATFORMS", "Platform", "arguments", "compile_binary", "host_platform"]

FLAGS: Final = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fvisibility=hidden")
"""Portable, and the same arithmetic on every platform: no fused multiply-add."""


@dataclass(frozen=True)
class Platform:
    """An operating system and processor that FMI has a folder for.

    ``name``: FMI 3.0's folder, and on the command line; ``fmi2``: FMI 2.0's folder; ``suffix``: of
    binaries; ``zig``: ziglang's target, None if only the host's own compiler can build for it.
    """

    name: str
    fmi2: str
    suffix: str
    zig: str | None

    def folder(self, version: int) -> str:
        """Below ``binaries/``."""
        return self.fmi2 if version == 2 else self.name

    def command(self) -> list[str]:
        """The compiler that builds for it here; InputError if there is none."""
        if self == host_platform():
            return list(find_compiler().command)
        if self.zig is None:
            raise InputError(f"binaries for {self.name} can only be built on {self.name}")
        if find_spec("ziglang") is None:
            raise InputError(
                f"a binary for {self.name} is cross-compiled with ziglang, which is missing: "
                "'pip install ziglang', or leave this platform out"
            )
        # stripped: what it strips names temporary files, which differ from build to build
        return [*RUN_MODULE, "ziglang", "cc", "-target", self.zig, "-s", "-g0"]


_KNOWN: Final = (  # the old glibc is for the binary to load on old systems too
    Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17"),
    Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
    Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
    Platform("x86_64-darwin", "darwin64", ".dylib", None),
    Platform("aarch64-darwin", "darwin64", ".dylib", None),
)
PLATFORMS: Final = {known.name: known for known in _KNOWN}


def host_platform() -> Platform:
    """The platform this runs on; InputError if FMI has no folder for it."""
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    return get_platform(f"{machine}-{platform.system().lower()}")


def get_platform(name: str) -> Platform:
    """By FMI 3.0 name, or linux64 or win64; InputError naming the known ones."""
    name = {"linux64": "x86_64-linux", "win64": "x86_64-windows"}.get(name, name)
    if name not in PLATFORMS:
        raise InputError(f"unknown platform '{name}'; known: {', '.join(PLATFORMS)}")
    return PLATFORMS[name]


def arguments(target: Platform, linked: Sequence[str], out: str, flags: Sequence[str]) -> list[str]:
    """What follows the compiler's name, in a folder that holds ``linked`` (libraries last)."""
    line = [*FLAGS, *flags, "-shared", *(["-fPIC"] if target.suffix != ".dll" else [])]
    line += ["-I.", *linked, "-lm", "-o", out]
    if target.suffix == ".so":
        # only FMI's own functions, also where libraries bring others; and nothing left undefined
        line += ["-Wl,--version-script=exports.map", "-Wl,-z,defs"]
    return line


def compile_binary(
    target: Platform, folder: Path, linked: Sequence[str], out: Path, flags: Sequence[str]
) -> None:
    """Compiles and links files in ``folder`` to the shared library ``out``.

    Raises CompileError with the compiler's words, InputError if no compiler serves.
    """
    line = [*target.command(), *arguments(target, linked, str(out), flags)]
    done = subprocess.run(
        line, cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode:
        raise CompileError(f"{shlex.join(line)}\n{done.stderr[:4000]}")
