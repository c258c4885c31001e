"""What a person sees while the parts work: a line per stage with its time.

A stage that needs results of the cache and computes none of them is marked as such.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Final, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bayesrace.cache import uses
from bayesrace.interrupts import raise_if_interrupted

__all__ = ["Stage", "Stages", "stages_on"]

_CACHED: Final = "from the cache"


class Stage(Protocol):
    """One stage of the work."""

    def update(self, share: float, text: str = "") -> None:
        """``share`` of it is done (0 to 1); ``text`` says what is going on."""


class Stages(Protocol):
    """Where stages are shown."""

    def stage(self, name: str) -> AbstractContextManager[Stage]:
        """Context of one stage, marked done when the block ends well; KeyboardInterrupt if not."""


class _Shown:
    def __init__(self, progress: Progress, name: str) -> None:
        self._progress = progress
        self._task = progress.add_task(name, total=1.0, note="")

    def update(self, share: float, text: str = "") -> None:
        self._progress.update(self._task, completed=min(share, 1.0), note=text)


class _RichStages:
    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        shown = _Shown(self._progress, name)
        with uses() as needed:
            yield shown
        raise_if_interrupted()
        shown.update(1.0, _CACHED if _all_found(needed) else "")


class _Silent:
    def update(self, share: float, text: str = "") -> None:
        """Nothing."""


@contextmanager
def stages_on(console: Console) -> Iterator[Stages]:
    """Stages as progress bars on the console, plain lines where it is not a terminal."""
    if not console.is_terminal:
        yield _PlainStages(console)
        return
    columns = (
        SpinnerColumn(finished_text="[green]✓"),
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as progress:
        yield _RichStages(progress)


class _PlainStages:
    def __init__(self, console: Console) -> None:
        self._console = console

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        self._console.print(f"{name} …", highlight=False)
        with uses() as needed:
            yield _Silent()
        raise_if_interrupted()
        if _all_found(needed):
            self._console.print(f"{name}: {_CACHED}", highlight=False)


def _all_found(needed: list[bool]) -> bool:
    return bool(needed) and not any(needed)
