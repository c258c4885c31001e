"""The files of a recording whose size is limited: ``run.mcap``, ``run.1.mcap``, ``run.2.mcap`` …

Each is a whole log. The oldest are deleted as new ones are written, the first one as well. Metadata
``part`` at the beginning of each says which recording it is of: ``recording``, ``number``,
``deleted`` (parts before it that are gone), ``repeated`` (messages at its beginning that stand in
an earlier part, too).
"""

import re
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import AfterValidator, ByteSize, TypeAdapter, ValidationError

from bayesrace.errors import InputError

__all__ = ["LEAST_BYTES", "PART", "LogSize", "log_size", "part_files", "part_path"]

PART: Final = "part"
"""Name of the metadata."""

LEAST_BYTES: Final = 10_000_000
"""Smallest limit of a recording: its parts are then still larger than a chunk."""


def part_path(path: Path, number: int) -> Path:
    """The file of a part; that of part 0 has the recording's own name."""
    return path.with_name(f"{path.stem}.{number}{path.suffix}") if number else path


def part_files(path: Path) -> dict[int, Path]:
    """The files there are with names of parts, by their numbers, in order."""
    named = re.compile(rf"{re.escape(path.stem)}\.([1-9]\d{{0,8}}){re.escape(path.suffix)}")
    found = {0: path} if path.is_file() else {}
    for file in path.parent.glob(f"*{path.suffix}") if path.suffix else ():
        if (number := named.fullmatch(file.name)) and file.is_file():
            found[int(number[1])] = file
    return dict(sorted(found.items()))


def _large_enough(size: ByteSize) -> ByteSize:
    if size < LEAST_BYTES:
        raise ValueError(f"at least {LEAST_BYTES // 10**6} MB")
    return size


LogSize = Annotated[ByteSize, AfterValidator(_large_enough)]
"""As a number of bytes, or with a unit: 500MB, 2GB, 1GiB."""


def log_size(text: str) -> int:
    """A limit as it is given on the command line [bytes]; InputError if it is none."""
    adapter: TypeAdapter[Any] = TypeAdapter(LogSize)
    try:
        return int(adapter.validate_python(text))
    except ValidationError:
        raise InputError(
            f"--max-log {text} is no size of a log: give a number with its unit, as 500MB or 2GB, "
            f"at least {LEAST_BYTES // 10**6}MB"
        ) from None
