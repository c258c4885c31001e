"""Files that appear whole or not at all, and are read whole or refused; locks on folders; temporary
folders, of which those of killed processes are deleted by the next one."""

import errno
import fcntl
import os
import re
import shutil
import stat
import tempfile
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from bayesrace.errors import InputError, faults_in

if TYPE_CHECKING:
    from pydantic import BaseModel

__all__ = [
    "check_private",
    "claimed",
    "clear_partials",
    "held",
    "parse_toml",
    "read_form",
    "read_text",
    "read_whole",
    "replacing",
    "temporary_folder",
    "write_whole",
]

Form = TypeVar("Form", bound="BaseModel")

_LARGEST: Final = 1 << 22
_PREFIX: Final = "bayesrace-held-"
"""Of temporary folders."""
_NEW_S: Final = 60.0
"""Age up to which the owner of a temporary folder may not hold it yet."""


def read_whole(
    path: Path, what: str, most: int = _LARGEST, remedy: str = "give an existing file"
) -> bytes:
    """The content of a file of at most ``most`` bytes.

    InputError, about ``what`` the file is, if it cannot be read or is longer, as a device may be.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except (OSError, ValueError) as error:  # a null byte in a path is a ValueError
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise InputError(f"cannot read {what} {path}: {reason}; {remedy}") from error
    if len(data) > most:
        raise InputError(f"{what} {path} is longer than {most >> 20} MB; {remedy}")
    return data


def read_text(path: Path, what: str, remedy: str = "give an existing file") -> str:
    """The same of a text in UTF-8, with or without a byte order mark."""
    data = read_whole(path, what, remedy=remedy)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{what} {path} is not text in UTF-8; {remedy}") from None


def parse_toml(text: str, name: object, remedy: str) -> dict[str, Any]:
    """The content of a TOML file of that name; InputError if it is none."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        why = str(error)
    twice = re.match(r"Cannot (?:declare .* twice|overwrite a value) \(at (?:line (\d+)|end)", why)
    heads = [line.partition("#")[0].partition("=")[0].strip() for line in text.split("\n")]
    again = int(twice[1] or len(heads)) if twice else 1
    earlier = [n for n, head in enumerate(heads[: again - 1], 1) if head == heads[again - 1]]
    if not earlier:
        raise InputError(f"{name} is no TOML: {why}; {remedy}")
    raise InputError(
        f"{name}: {heads[again - 1]} stands in line {earlier[-1]} and again in line {again}: write "
        "all of it in one of these places, and remove the other"
    )


def read_form(path: Path, what: str, remedy: str, form: type[Form]) -> Form:
    """A TOML file by its pydantic model; InputError naming it, every fault and the remedy."""
    from pydantic import ValidationError  # takes time, and --help needs none

    content = parse_toml(read_text(path, what, remedy), path, remedy)
    try:
        return form.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {faults_in(error, 'the file', form)}") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write that takes the place of ``path`` when the block has ended without an error.

    It is on the disk before it does: after a power failure ``path`` is the old file or the new one.
    It is beside ``path`` and has the same suffix, as some writers add what they miss. OSError as
    of the block, or of the system, but about ``path``; what was begun is deleted then. A device,
    which root could replace, is an OSError, too.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    unique = f"{os.getpid()}.{time.monotonic_ns()}"
    partial = path.with_name(f".{path.stem}.{unique}.part{path.suffix}")
    try:
        yield partial
        _sync(partial)
        partial.replace(path)
    except OSError as error:  # of a full disk it does not say which file
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    # The name, too; the content is safe without it, and not every file system can do this.
    with suppress(OSError):
        _sync(path.parent)


def write_whole(path: Path, data: str | bytes, *, private: bool = False) -> None:
    """The content of a file, text in UTF-8; see :func:`replacing`.

    ``private``: others can read it at no moment.
    """
    with replacing(path) as partial:
        if private:
            partial.touch(0o600, exist_ok=False)
        partial.write_bytes(data.encode() if isinstance(data, str) else data)


def check_private(key: Path) -> None:
    """InputError if others can read the key: theirs may be a group, where root owns the file."""
    status = key.stat()
    forbidden = 0o077 if status.st_uid else 0o027
    if stat.S_IMODE(status.st_mode) & (forbidden if os.geteuid() else 0o077):
        raise InputError(f"others can read the private key {key}: chmod 600 {key}")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Holds a lock on a folder, which the system releases however this process ends.

    BlockingIOError if another one holds it; another OSError where there are no such locks.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Makes a folder, for this process alone where there are locks.

    InputError if another one writes there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(held(folder))
        except BlockingIOError:
            raise InputError(
                f"another process writes to {folder}: wait for its end, or give another folder"
            ) from None
        except OSError:
            pass
        yield


def clear_partials(folder: Path) -> None:
    """Deletes what killed processes have begun; only while no process writes there."""
    for partial in folder.glob(".*.part*"):
        partial.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """OSError if the content cannot be brought to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
