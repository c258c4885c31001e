"""Platforms that code is built for: this one by its own compiler, others by a cross-compiler."""

import platform
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from bayesrace.codegen.compiler import Compiler, find_compiler
from bayesrace.errors import InputError
from bayesrace.processes import RUN_MODULE

__all__ = ["PLATFORMS", "Platform", "get_platform", "host_platform"]


@dataclass(frozen=True)
class Platform:
    """An operating system and processor that FMI has a folder for.

    ``name``: FMI 3.0's folder, and on the command line; ``fmi2``: FMI 2.0's folder; ``suffix``: of
    binaries; ``zig``: ziglang's target; ``machine``: its number in ELF files, 0 where others are
    used.
    """

    name: str
    fmi2: str
    suffix: str
    zig: str
    machine: int = 0

    def folder(self, version: int) -> str:
        """Below ``binaries/``."""
        return self.fmi2 if version == 2 else self.name

    def compiler(self) -> Compiler:
        """What builds for it here; InputError if there is nothing."""
        if self == host_platform():
            return find_compiler()
        if find_spec("ziglang") is None:
            raise InputError(
                f"a binary for {self.name} is cross-compiled with ziglang, which is missing: "
                "'pip install ziglang', or leave this platform out"
            )
        # stripped: what it strips names temporary files, which differ from build to build
        command = (*RUN_MODULE, "ziglang", "cc", "-target", self.zig, "-s", "-g0")
        return Compiler(command, f"ziglang {version('ziglang')}, {self.zig}")

    def check(self, library: Path, compiler: Compiler) -> None:
        """InputError if a library that the compiler has made is for another platform."""
        with library.open("rb") as file:
            head = file.read(20)
        if head[:4] != b"\x7fELF" or int.from_bytes(head[18:20], "little") != self.machine:
            raise InputError(
                f"{' '.join(compiler.command)} does not compile for {self.name}: set CC to a "
                "compiler that does, or unset it, for ziglang to be used"
            )


_KNOWN: Final = (  # the old glibc is for the binary to load on old systems too
    Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17", 62),
    Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17", 183),
    Platform("aarch32-linux", "aarch32-linux", ".so", "arm-linux-gnueabihf.2.17", 40),  # ARMv7
    Platform("riscv64-linux", "riscv64-linux", ".so", "riscv64-linux-gnu.2.27", 243),
    Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
)
PLATFORMS: Final = {known.name: known for known in _KNOWN}


def host_platform() -> Platform:
    """The platform this runs on; InputError if FMI has no folder for it."""
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64", "armv7l": "aarch32"}.get(machine, machine)
    return get_platform(f"{machine}-{platform.system().lower()}")


def get_platform(name: str) -> Platform:
    """By the name of FMI 3.0; InputError naming the known ones."""
    if name not in PLATFORMS:
        raise InputError(f"unknown platform '{name}'; known: {', '.join(PLATFORMS)}")
    return PLATFORMS[name]
