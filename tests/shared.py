"""What many tests need and none changes: made once, then shared by all workers."""

import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from bayesrace.cache import cache_folder, digest, locked

__all__ = ["session_folder", "shared_folder"]


def shared_folder(name: str, parts: Iterable[str | bytes], make: Callable[[Path], object]) -> Path:
    """A folder of the product's cache that ``make`` has filled, for later runs, too.

    ``parts``: everything that its content depends on.
    """
    return _made(cache_folder() / "tests" / f"{name}-{digest(parts)}", make)


def session_folder(
    factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]
) -> Path:
    """A folder that ``make`` has filled, for this run alone: each run makes it anew.

    TEST_SESSION names a folder for several runs of pytest that are one, as in ``make check``.
    """
    own = factory.getbasetemp()
    run = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    return _made(Path(os.environ.get("TEST_SESSION", run)) / name, make)


def _made(folder: Path, make: Callable[[Path], object]) -> Path:
    with locked(folder):
        if not folder.exists():
            partial = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
            partial.mkdir(parents=True)
            make(partial)
            partial.rename(folder)
    return folder
