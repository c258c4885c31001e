"""Results that take seconds to compute, kept in files named after everything that shaped them.

Built controllers, racing lines and trained weights depend on settings, sources and libraries alone.
Each is made once and read from then on, by every process of the user on this machine.
"""

import fcntl
import hashlib
import os
import platform
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Final, TypeVar

from bayesrace.errors import InputError
from bayesrace.files import replacing, temporary_folder
from bayesrace.trusted_files import make_folder, trusted

__all__ = [
    "cache_folder",
    "code_folder",
    "cpu_digest",
    "cpu_identity",
    "digest",
    "kept",
    "locked",
    "note_use",
    "software",
    "uses",
]

Result = TypeVar("Result")

_PACKAGE: Final = Path(__file__).parent


_uses: ContextVar[list[bool] | None] = ContextVar("uses", default=None)


@contextmanager
def uses() -> Iterator[list[bool]]:
    """For each result that this thread needs within the block: whether it is made anew."""
    noted: list[bool] = []
    token = _uses.set(noted)
    try:
        yield noted
    finally:
        _uses.reset(token)


def note_use(made: bool) -> None:
    """Adds a result to the :func:`uses` of the block around, if there is one."""
    noted = _uses.get()
    if noted is not None:
        noted.append(made)


def cache_folder() -> Path:
    """$BAYESRACE_CACHE, else the user's cache folder; InputError if there is none."""
    chosen = os.environ.get("BAYESRACE_CACHE")
    if chosen:
        return Path(chosen)
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no HOME, and a user whom the system does not know
        raise InputError("there is no home folder for the cache; set BAYESRACE_CACHE") from None
    return Path(base) / "bayesrace"


def code_folder() -> Path:
    """The :func:`cache_folder`, made if need be, for results that are executed.

    InputError if it cannot be made, or other users could exchange what is there.
    """
    return trusted(cache_folder(), make=True)


def digest(parts: Iterable[str | bytes]) -> str:
    """Sixteen hexadecimal digits that change with any part."""
    sha = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        sha.update(len(data).to_bytes(8, "little") + data)
    return sha.hexdigest()[:16]


def software(sources: Iterable[str], packages: Iterable[str]) -> Iterator[str | bytes]:
    """Contents of our sources, files or folders of files in ``bayesrace``, and package versions.

    Parts for :func:`digest`: a result is made anew when the code that makes it changes.
    """
    for name in sources:
        path = _PACKAGE / name
        for source in sorted(path.iterdir()) if path.is_dir() else [path]:
            if source.suffix in (".py", ".c", ".h"):
                yield source.name
                yield source.read_bytes()
    yield from (f"{name} {version(name)}" for name in packages)


@cache
def cpu_identity() -> str:
    """Model and features: a library built on one CPU may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(dict.fromkeys(s for s in lines if s.startswith(wanted)))


def cpu_digest() -> str:
    """Short form of :func:`cpu_identity`."""
    return hashlib.sha256(cpu_identity().encode()).hexdigest()[:12]


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds a lock named after ``path`` against all other processes and threads that ask for it.

    Raises InputError if there can be no lock beside ``path``.
    """
    locks = path.parent / ".locks"
    try:
        make_folder(locks)
        file = (locks / path.name).open("w")
    except OSError as error:
        raise InputError(
            f"cache {path.parent}: {error.strerror or error}; set BAYESRACE_CACHE to a folder "
            "that can be written"
        ) from None
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def kept(path: Path, make: Callable[[Path], None], read: Callable[[Path], Result]) -> Result:
    """What ``read`` returns of the file, after ``make`` has written it if there is no usable one.

    ``read`` raises InputError for a file that is absent or damaged. Of several processes that need
    the file at once, one makes it and the others wait. Raises what ``make`` raises.
    """

    def read_found() -> Result:
        result = read(path)
        note_use(made=False)
        return result

    with suppress(InputError):
        return read_found()
    with locked(path):
        with suppress(InputError):  # made by another process, meanwhile
            return read_found()
        # No other user can open it for writing while its mode is that of the umask.
        with replacing(path) as partial, temporary_folder(str(path.parent)) as own:
            made = own / partial.name
            make(made)
            made.chmod(made.stat().st_mode & 0o755)
            made.replace(partial)
    note_use(made=True)
    return read(path)
