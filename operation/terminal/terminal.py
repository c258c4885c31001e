"""The console on which tables are printed, what all tables look like, and the stages of the work.

A stage that needs results of the cache and computes none of them is marked as such.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.segment import Segment
from rich.table import Table

from bayesrace.cache import uses
from bayesrace.operation.terminal import printable_lines
from bayesrace.processes import raise_if_interrupted

__all__ = ["Stage", "Stages", "Terminal", "plain_table", "stages_on"]

_CACHED: Final = "from the cache"


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


class Stage:
    """One stage of the work, on a progress bar if there is one."""

    def __init__(self, progress: Progress | None, task: TaskID) -> None:
        self._progress, self._task = progress, task

    def update(self, share: float, text: str = "") -> None:
        """Shows that ``share`` of it is done (0 to 1), and with ``text`` what is being done."""
        if self._progress is not None:
            self._progress.update(self._task, completed=min(share, 1.0), note=text)


class Stages:
    """All stages of a command: progress bars, or plain lines on the console without them."""

    def __init__(self, console: Console, progress: Progress | None) -> None:
        self._console, self._progress = console, progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Context of one stage, marked done when the block ends well; KeyboardInterrupt if not."""
        bars, task = self._progress, TaskID(0)
        if bars is not None:
            task = bars.add_task(name, total=1.0, note="")
        else:
            self._console.print(f"{name} …", highlight=False)
        stage = Stage(bars, task)
        with uses() as needed:
            yield stage
        raise_if_interrupted()
        found = bool(needed) and not any(needed)
        stage.update(1.0, _CACHED if found else "")
        if found and bars is None:
            self._console.print(f"{name}: {_CACHED}", highlight=False)


@contextmanager
def stages_on(console: Console) -> Iterator[Stages]:
    """Stages as progress bars on the console, plain lines where it is not a terminal."""
    if not console.is_terminal:
        yield Stages(console, None)
        return
    columns = (
        SpinnerColumn(finished_text="[green]✓"),
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as progress:
        yield Stages(console, progress)
