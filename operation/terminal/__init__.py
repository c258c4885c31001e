"""Tables and progress on the terminal; here: printable text, and names in tables and figures.

Names of files and tracks, and texts from logs and from the network, may hold escape sequences.
"""

import logging
from typing import Final

__all__ = [
    "SMOOTHNESS",
    "SYMBOLS",
    "UNCERTAIN",
    "PrintableFormatter",
    "printable",
    "printable_lines",
]

SYMBOLS: Final = {"vx": "vx", "vy": "vy", "omega": "ω"}
"""Outputs in figures."""

SMOOTHNESS: Final = {"matern05": "1/2", "matern15": "3/2", "matern25": "5/2", "rbf": "∞"}
"""Kernels from rough to smooth, and their nu."""

UNCERTAIN: Final = 0.25
"""The paper marks where the largest of the three standard deviations is above this."""


def printable(text: str) -> str:
    """The text with a dot in place of each control character: escapes, line ends."""
    return "".join(c if c.isprintable() else "·" for c in text)


def printable_lines(text: str) -> str:
    """The same, line by line."""
    return "\n".join(printable(line) for line in text.split("\n"))


class PrintableFormatter(logging.Formatter):
    """Of log lines."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, or lines where there is a traceback."""
        return printable_lines(super().format(record))
