"""What reaches a terminal: its own colours, and nothing that a name or a message wants of it."""

import io
import logging

from rich.table import Table

from bayesrace.operation.terminal import PrintableFormatter
from bayesrace.operation.terminal.terminal import Terminal

EVIL = "a\x1b[2Jb\x07c"


def test_tables_hold_no_escape_sequences_but_their_own() -> None:
    text = io.StringIO()
    table = Table("track", title=EVIL)
    table.add_row(f"[bold]{EVIL}[/bold]")
    Terminal(file=text, force_terminal=True, width=60, color_system="truecolor").print(table)
    printed = text.getvalue()
    assert "\x1b[2J" not in printed
    assert "\x07" not in printed
    assert printed.count("a·[2Jb") == 2
    assert "\x1b[1m" in printed


def test_log_lines_hold_no_escape_sequences() -> None:
    record = logging.LogRecord("plant", logging.INFO, "", 0, "said %s\nand more", (EVIL,), None)
    assert PrintableFormatter("%(message)s").format(record) == "said a·[2Jb·c\nand more"
