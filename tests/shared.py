"""What many tests need and none changes: made once, then shared by all workers and later runs.

Each thing lies in a folder of the product's cache, named after all that shaped it.
"""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from bayesrace.cache import cache_folder, digest, locked

__all__ = ["shared_folder"]


def shared_folder(name: str, parts: Iterable[str | bytes], make: Callable[[Path], object]) -> Path:
    """A folder that ``make`` has filled; ``parts``: everything that its content depends on."""
    folder = cache_folder() / "tests" / f"{name}-{digest(parts)}"
    if folder.exists():
        return folder
    with locked(folder):
        if not folder.exists():
            partial = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
            partial.mkdir()
            make(partial)
            partial.rename(folder)
    return folder
