"""Temporary folders, of which those of killed processes are deleted by the next one."""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

__all__ = ["temporary_folder"]

_PREFIX: Final = "bayesrace-held-"
_NEW_S: Final = 60.0
"""Age up to which the owner of a folder may not hold its lock yet."""


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder that only this user may enter, deleted at the block's end.

    This process holds a lock on it meanwhile, which the system releases however it ends.
    """
    _clear_abandoned(Path(tempfile.gettempdir()))
    with (
        tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True) as folder,
        ExitStack() as stack,
    ):
        stack.callback(os.close, descriptor := os.open(folder, os.O_RDONLY))
        with suppress(OSError):  # not every file system has locks; there, nothing is cleared
            fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield Path(folder)


def _clear_abandoned(parent: Path) -> None:
    """Deletes this user's folders that no process holds."""
    for folder in parent.glob(f"{_PREFIX}*"):
        with suppress(OSError), ExitStack() as stack:
            found = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            stack.callback(os.close, found)
            status = os.fstat(found)
            if status.st_uid == os.geteuid() and time.time() - status.st_mtime > _NEW_S:
                fcntl.flock(found, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
