"""What a controller takes of memory, as the compiler has it."""

import re
from pathlib import Path
from typing import Final

from bayesrace.codegen.build import NATIVE, casadi_includes, problem_of, write_sizes
from bayesrace.codegen.compiler import FLAGS, Compiler, find_compiler
from bayesrace.codegen.settings import BuildSettings
from bayesrace.files import temporary_folder

__all__ = ["WHOLE", "Memory", "memory_of", "planned_memory"]

WHOLE: Final = ("controller", "cycle")
"""What a host has to provide; everything else is a part of the one before it."""

Memory = dict[str, int]
"""Bytes of these, each with its parts behind it. A host has messages and a stack beside them."""

_SOURCE: Final = Path(__file__).with_name("sizes.c")
_SIZE: Final = re.compile(r"->(\w+) (\d+);")


def planned_memory(settings: BuildSettings) -> Memory:
    """Of a controller that is not built, on this machine; pointers are shorter on 32-bit ones."""
    with temporary_folder() as folder:
        write_sizes(problem_of(settings), settings, folder)
        return memory_of(find_compiler(by_name=True), FLAGS, folder, NATIVE, casadi_includes()[0])


def memory_of(compiler: Compiler, flags: tuple[str, ...], *headers: Path) -> Memory:
    """Of the controller whose headers are in these folders, such as its artefact."""
    with temporary_folder() as temporary:
        text = temporary / "sizes.s"
        seen = (f"-I{folder}" for folder in headers)
        compiler.run(*flags, "-O0", *seen, "-S", _SOURCE, "-o", text)
        return {part: int(size) for part, size in _SIZE.findall(text.read_text())}
