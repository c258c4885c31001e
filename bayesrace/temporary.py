"""Temporary folders, of which those of killed processes are deleted by the next one."""

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from bayesrace.files import held

__all__ = ["temporary_folder"]

_PREFIX: Final = "bayesrace-held-"
_NEW_S: Final = 60.0
"""Age up to which the owner of a folder may not hold it yet."""


@contextmanager
def temporary_folder(parent: str | None = None) -> Iterator[Path]:
    """A new folder that only this user may enter, deleted at the block's end; in ``TMPDIR``, or
    in ``parent``."""
    _clear_abandoned(Path(parent or tempfile.gettempdir()))
    with (
        tempfile.TemporaryDirectory(
            prefix=_PREFIX, dir=parent, ignore_cleanup_errors=True
        ) as folder,
        ExitStack() as stack,
    ):
        with suppress(OSError):  # without locks: there, nothing is cleared either
            stack.enter_context(held(Path(folder)))
        yield Path(folder)


def _clear_abandoned(parent: Path) -> None:
    """Deletes this user's folders that no process holds."""
    for folder in parent.glob(f"{_PREFIX}*"):
        with suppress(OSError):
            status = folder.lstat()
            if status.st_uid == os.geteuid() and time.time() - status.st_mtime > _NEW_S:
                with held(folder):
                    shutil.rmtree(folder, ignore_errors=True)
