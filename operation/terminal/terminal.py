"""The console on which tables are printed, and what all tables look like."""

from collections.abc import Iterable

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table

from bayesrace.operation.terminal.printable import printable_lines

__all__ = ["Terminal", "plain_table"]


class Terminal(Console):
    """A console that sends no escape sequences but its own."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """The segments of what is printed, with printable texts."""
        for segment in super().render(renderable, options):
            yield (
                segment if segment.control else segment._replace(text=printable_lines(segment.text))
            )


def plain_table(*titles: str, left: int = 1, padding: int = 1) -> Table:
    """A table without frame whose first ``left`` columns hold text, the others numbers.

    Where the terminal is narrow, texts wrap, but numbers are never cut. ``padding``: blanks on both
    sides of a cell.
    """
    table = Table(box=box.SIMPLE_HEAD, padding=(0, padding), pad_edge=False, show_edge=False)
    for number, title in enumerate(titles):
        table.add_column(
            title, justify="left" if number < left else "right", vertical="bottom",
            no_wrap=number >= left, overflow="fold",
        )  # fmt: skip
    return table
