"""The static library, for a processor whose programs are linked as a whole."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.codegen.boards.memory import memory_of
from bayesrace.codegen.compiler import FLAGS, CompileError, Compiler, chosen_command, version_of
from bayesrace.errors import InputError
from bayesrace.files import temporary_folder, write_whole

__all__ = ["BOARDS", "Board", "add_library", "board_compiler"]

LIBRARY: Final = "libbayesrace.a"
HEADER: Final = "bayesrace_memory.h"
"""Sizes of what a firmware provides, which has no heap to ask for them."""

_IMAGE: Final = Path(__file__).with_name("image.c")


@dataclass(frozen=True)
class Board:
    """A processor, and how C is compiled for it.

    ``name``: on the command line; ``processor``: the compiler's options for it.
    """

    name: str
    processor: tuple[str, ...]
    command: str = "arm-none-eabi-gcc"
    packages: str = "gcc-arm-none-eabi and libnewlib-arm-none-eabi (Debian)"

    @property
    def flags(self) -> tuple[str, ...]:
        """Of the compiler: as on other machines, but that unused functions can be left out."""
        own = (flag for flag in FLAGS if flag not in ("-fPIC", "-fvisibility=hidden", "-O3"))
        return (*own, "-Os", *self.processor, "-ffunction-sections", "-fdata-sections")


BOARDS: Final = {
    one.name: one
    for one in (
        Board("cortex-m7", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb")),
    )
}


def board_compiler(board: Board) -> Compiler:
    """What ``CC`` names, or else is found by name; InputError if it does not compile for it."""
    command = chosen_command() or (board.command,)
    words = " ".join(command)
    if shutil.which(command[0]) is None:
        raise InputError(
            f"no compiler for {board.name} ({words}): install {board.packages}, or set CC"
        )
    with temporary_folder() as folder:
        (folder / "probe.c").write_text("#include <math.h>\n#include <string.h>\n")
        line = [*command, *board.flags, "-c", "probe.c", "-o", "probe.o"]
        done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no word of why"])[-1]
        raise InputError(
            f"{words} does not compile for {board.name} ({said}): install {board.packages}, or set "
            "CC to a compiler that does"
        )
    return Compiler(command, version_of(command))


def add_library(artefact: Path, board: Board, compiler: Compiler) -> str:
    """Compiles an artefact's C, that of DAQP included, to :data:`LIBRARY` in its folder, beside
    :data:`HEADER`; a report of what both take of a board's memory.

    ``compiler``: of :func:`board_compiler`. The clock is left out, which the firmware has to give.
    """
    sources = {*artefact.glob("*.c"), *(artefact / "daqp").glob("*.c")} - {artefact / "br_clock.c"}
    memory = memory_of(compiler, board.flags, artefact)
    header = (
        "/* generated: bytes that br_mpc_init and br_cycle_drive_mpc want, aligned to 64 */\n"
        f"#define BR_MPC_BYTES {memory['controller']}\n#define BR_CYCLE_BYTES {memory['cycle']}\n"
    )
    write_whole(artefact / HEADER, header)
    with temporary_folder() as folder:
        objects = compiler.objects(sorted(sources), [artefact], board.flags, folder)
        library = folder / LIBRARY
        _tool(compiler, "ar", "rcsD", library, *objects)
        image = folder / "image"
        how = (*board.flags, "-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections,-e,main")
        compiler.run(*how, f"-I{artefact}", _IMAGE, library, "-lm", "-o", image)
        text, data, bss = map(int, _tool(compiler, "size", image).splitlines()[1].split()[:3])
        write_whole(artefact / LIBRARY, library.read_bytes())
    return (
        f"{board.name}: {(text + data) / 1000:.0f} kB of flash; {(data + bss) / 1000:.0f} kB of "
        f"RAM beside the stack, {memory['controller'] / 1000:.0f} of them the controller's and "
        f"{memory['cycle'] / 1000:.0f} the cycle's"
    )


def _tool(compiler: Compiler, name: str, *arguments: str | Path) -> str:
    """Runs a tool that the compiler comes with; its output."""
    found = compiler.run(f"-print-prog-name={name}").strip()
    line = [found, *map(str, arguments)]
    try:
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise CompileError(f"{found}: {getattr(error, 'stderr', '') or error}") from None
