"""Controllers for processors without an operating system: a static library for a board's firmware,
and what it takes of the board's memory."""

from bayesrace.codegen.boards.library import BOARDS, Board, add_library, board_compiler
from bayesrace.codegen.boards.memory import WHOLE, Memory, planned_memory

__all__ = [
    "BOARDS", "WHOLE", "Board", "Memory", "add_library", "board_compiler", "planned_memory"
]  # fmt: skip
