"""DAQP's C, from its source distribution: for platforms that the CasADi wheel here is not for."""

import tarfile
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError

__all__ = ["HOW_TO_GET", "VERSION", "unpack_sources"]

VERSION: Final = "0.5.1"
"""Of those that are published, the one with the headers of CasADi's copy."""

HOW_TO_GET: Final = (
    f"'pip download --no-deps --no-binary daqp daqp=={VERSION}', then --daqp daqp-{VERSION}.tar.gz"
)

_LARGEST: Final = 1 << 20
"""Bytes of a file; theirs have some ten thousand."""


def unpack_sources(distribution: Path, folder: Path) -> None:
    """Adds DAQP's C files to a folder with CasADi's headers of it.

    InputError if the file is no source distribution of DAQP, or has other headers.
    """
    wrong = f"{distribution} is no source distribution of DAQP that fits: {HOW_TO_GET}"
    found: dict[str, bytes] = {}
    try:
        with tarfile.open(distribution) as archive:
            for member in archive:
                path = Path(member.name)
                if "csrc" not in path.parts or path.suffix not in (".c", ".h"):
                    continue
                if member.size < _LARGEST and (file := archive.extractfile(member)):
                    found[path.name] = file.read()
    except (OSError, tarfile.TarError, EOFError) as error:
        raise InputError(f"{wrong} ({error})") from None
    headers = {name: data for name, data in found.items() if name.endswith(".h")}
    for name, data in headers.items():
        ours = folder / name
        if not ours.is_file() or ours.read_bytes() != data:
            raise InputError(f"{wrong} ({name} is not that of CasADi)")
    if "api.h" not in headers or "api.c" not in found:
        raise InputError(wrong)
    for name in found.keys() - headers.keys():
        (folder / name).write_bytes(found[name])
