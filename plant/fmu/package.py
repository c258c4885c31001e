"""An FMU file: its description read and its content unpacked, every fault of it an InputError."""

import os
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from fmpy import platform, platform_tuple, read_model_description, sharedLibraryExtension

from bayesrace.errors import InputError

__all__ = ["extract", "library", "read_description"]

_MOST_BYTES: Final = 2 << 30
"""Unpacked; an archive that claims more is damaged or an attack on the disk."""

_LARGEST_XML: Final = 16_000_000
"""Bytes of a model description; a hundred thousand variables."""


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive; InputError if the file is none, damaged, or encrypted."""
    if not path.is_file():
        raise InputError(f"no FMU at {path}; give the path of an .fmu file")
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except (OSError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"{path} is no FMU, or a damaged one ({error}); export or copy it again"
        ) from None


def read_description(path: str | os.PathLike[str]) -> Any:
    """The ``ModelDescription`` (fmpy) of an FMU 2.0 or 3.0, whatever its kind.

    InputError if the file is none. Small offences against the schema are overlooked.
    """
    path = Path(path)
    with _opened(path) as archive:
        if "modelDescription.xml" not in archive.namelist():
            raise InputError(f"{path} is an archive without a modelDescription.xml: no FMU")
        size = archive.getinfo("modelDescription.xml").file_size
        if size > _LARGEST_XML:
            raise InputError(
                f"{path}: its modelDescription.xml has {size / 1e6:.0f} MB, at most "
                f"{_LARGEST_XML / 1e6:.0f} are read: export it with fewer variables"
            )
        with archive.open("modelDescription.xml") as xml:
            head = xml.read(1 << 16)
    stated = re.search(rb"fmiVersion\s*=\s*[\"']([^\"']*)[\"']", head)
    version = stated.group(1).decode(errors="replace") if stated else "none"
    if version != "2.0" and not version.startswith("3."):
        raise InputError(
            f"{path} is for FMI version {version}; versions 2.0 and 3.0 are read: export it so"
        )
    try:
        return read_model_description(str(path), validate=False)
    except Exception as error:  # fmpy fails with whatever the first wrong line leads to
        raise InputError(f"{path}: its modelDescription.xml cannot be read: {error}") from None


def extract(path: Path, folder: Path) -> None:
    """Unpacks the FMU into an existing folder, and nowhere else; InputError if it cannot be."""
    with _opened(path) as archive:
        for name in archive.namelist():
            if name.startswith("/") or ".." in name.split("/") or "\\" in name or ":" in name:
                raise InputError(
                    f"{path} holds '{name[:200]}', a path that leads out of its folder: not "
                    "unpacked; do not use this file"
                )
        if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
            raise InputError(f"{path} claims to unpack to more than {_MOST_BYTES >> 30} GiB")
        archive.extractall(folder)


def library(path: Path, folder: Path, description: Any) -> Path:
    """The shared library of the unpacked FMU for this computer.

    InputError that says which platforms the FMU is for, if it is not for this one.
    """
    name: str = description.coSimulation.modelIdentifier + sharedLibraryExtension
    if "/" in name or "\\" in name:
        raise InputError(f"{path} names '{name[:200]}' as its library, which is no file name")
    # FMI 2.0 names Intel's platforms alone; for others the names of 3.0 are in use.
    fits = [platform_tuple]
    if description.fmiVersion == "2.0":
        fits.insert(0 if platform_tuple.startswith("x86") else 1, platform)
    for one in fits:
        path_here: Path = folder / "binaries" / one / name
        if path_here.is_file():
            return path_here
    there = sorted(one.name for one in (folder / "binaries").glob("*") if any(one.iterdir()))
    sources = " (its sources are inside)" if (folder / "sources").is_dir() else ""
    raise InputError(
        f"{path} is for {', '.join(there) or 'no platform at all'}{sources}, not for this "
        f"computer, {platform_tuple}: export it with binaries/{fits[0]}/{name}"
    )
