"""Files whose content is executed: libraries, and what describes them.

Who may write such a file, or exchange it in a folder above it, can run code as the user who loads
it.
"""

import grp
import os
import pwd
import stat
from pathlib import Path
from typing import BinaryIO, Final

from bayesrace.errors import InputError

__all__ = ["loadable", "make_folder", "trusted"]

_ROOT: Final = 0

_loaded: dict[str, int] = {}
"""Descriptors of libraries by SHA-256. They stay open: the loader knows a library by its name, and
would return it for the next one that is opened with the same number."""


def trusted(path: Path, *, make: bool = False) -> Path:
    """The same file or folder without symbolic links, which no other user can change or exchange.

    InputError unless it and all folders above belong to this user or to root, and only they may
    write there. A folder with the sticky bit, such as ``/tmp``, may be writable: what is there can
    be exchanged by its owner alone. OSError if there is none; with ``make`` a folder is made.
    """
    real = Path(os.path.realpath(path, strict=not make))
    for one in (*reversed(real.parents), real):  # what is below those checked cannot be exchanged
        if make:
            make_folder(one)
        _check(one, one.lstat())
    return real


def _check(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (os.geteuid(), _ROOT):
        raise InputError(
            f"{path} belongs to another user (number {status.st_uid}), who could exchange code "
            "that is executed: run as that user, or keep it in a folder of yours (BAYESRACE_CACHE, "
            "'bayesrace build --out')"
        )
    group = status.st_mode & stat.S_IWGRP and not _private(path, status.st_gid)
    sticky = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    if (group or status.st_mode & stat.S_IWOTH) and not sticky:
        raise InputError(
            f"{path} is writable for other users, who could exchange code that is executed: "
            "'chmod go-w' it if you know what it holds, or remove it"
        )


def _private(path: Path, group: int) -> bool:
    """Whether a group's right to write is this user's, or root's, alone: Debian and others make a
    group for each user, of the same name, which may write by default. Without an entry, as in some
    containers, there may be anybody in it."""
    try:
        named = grp.getgrgid(group)
        owner = pwd.getpwnam(named.gr_name)
        lists = os.listxattr(path)
    except (KeyError, OSError):
        return False
    members = {*named.gr_mem, *(one.pw_name for one in pwd.getpwall() if one.pw_gid == group)}
    return (
        owner.pw_gid == group
        and owner.pw_uid in (os.geteuid(), _ROOT)
        and members <= {owner.pw_name}
        and "system.posix_acl_access" not in lists  # the group's bits bound others' rights, too
    )


def loadable(file: BinaryIO, sha256: str) -> Path:
    """A path by which the loader finds the opened library of that SHA-256, whatever has become of
    its name, until the process ends.

    Only Linux has such paths. Libraries of equal content are loaded as one.
    """
    if sha256 not in _loaded:
        _loaded[sha256] = os.dup(file.fileno())
    return Path(f"/proc/self/fd/{_loaded[sha256]}")


def make_folder(folder: Path) -> None:
    """Makes a folder, and those above it, in which no other user may write whatever the umask.

    InputError if it cannot be made.
    """
    try:
        for one in (*reversed(folder.parents), folder):
            if not one.exists():
                one.mkdir(0o755, exist_ok=True)  # another process may have made it meanwhile
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made ({error.strerror}): choose another folder; the cache's is "
            "BAYESRACE_CACHE"
        ) from None
