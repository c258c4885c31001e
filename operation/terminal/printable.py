"""Text in which a terminal finds nothing to obey.

Names of files and tracks, and texts from logs and from the network, may hold escape sequences.
"""

import logging

__all__ = ["PrintableFormatter", "printable", "printable_lines"]


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
