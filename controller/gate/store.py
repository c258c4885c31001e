"""Accepted weights in a folder, so that they survive the controller.

``index.json`` says what is there and in which order; every file appears whole or not at all. The
last entry of the index is the one in use.
"""

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayesrace.errors import InputError
from bayesrace.files import read_text, read_whole, write_whole
from bayesrace.gp.weights import MAX_BYTES, decode_weights

__all__ = ["HISTORY", "WITHDRAWN", "Accepted", "Store", "digest_of", "trimmed"]

HISTORY: Final = 8
"""Accepted weights that are kept."""

WITHDRAWN: Final = 32
"""Digests of given up weights that are kept."""

_INDEX: Final = "index.json"


@dataclass(frozen=True)
class Accepted:
    """Weights as the controller has accepted them."""

    number: int
    """Rising with each acceptance; 0: what the controller was started with."""
    version: str
    data: bytes
    """The file; empty: without correction."""
    proven: bool
    """Watched to the end of its time."""
    accepted_utc_ns: int = 0
    """Since 1970, by the clock of the controller that accepted it first; 0: not known, which counts
    as older than all others."""


_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    number: int = Field(ge=1)
    version: str
    file: str = Field(pattern=r"^[0-9a-f-]+\.bin$")
    digest: _Digest
    proven: bool
    accepted_utc_ns: int = Field(0, ge=0)


class _Index(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = Field(1, ge=1, le=1)
    next_number: int = Field(1, ge=1)
    discretisation: str = ""
    """Of the controller that accepted them."""
    entries: tuple[_Entry, ...] = ()
    withdrawn: tuple[_Digest, ...] = ()
    """Digests of weights that were given up while they were watched."""


class _Proven(Protocol):
    @property
    def proven(self) -> bool: ...


P = TypeVar("P", bound=_Proven)


def trimmed(history: Sequence[P]) -> list[P]:
    """The newest ones, and in any case the newest that have proved good: others may all be bad."""
    kept = list(history[-HISTORY:])
    if not any(one.proven for one in kept):
        kept = [one for one in history if one.proven][-1:] + kept
    return kept


def digest_of(data: bytes) -> str:
    """Name of a weights file's content."""
    return hashlib.sha256(data).hexdigest()


class Store:
    """The folder of one controller."""

    def __init__(self, folder: Path, discretisation: str) -> None:
        """InputError if it cannot be used or belongs to a controller that predicts otherwise."""
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"store {folder}: {error.strerror}; choose another folder") from None
        there = os.access(folder / _INDEX, os.F_OK)
        text = read_text(folder / _INDEX, "the store's index") if there else ""
        try:
            self._index = _Index.model_validate_json(text) if text else _Index()
        except ValidationError:
            raise InputError(
                f"store {folder}: {_INDEX} is damaged; remove it, or choose another folder"
            ) from None
        known = self._index.discretisation
        if known and known != discretisation:
            raise InputError(
                f"store {folder} holds weights for {known}, this controller predicts with "
                f"{discretisation}; choose another folder"
            )
        self._index = self._index.model_copy(update={"discretisation": discretisation})
        # Now, not while driving, it is told that a folder cannot be written.
        self._write_index(self._index)

    @property
    def next_number(self) -> int:
        """What the next acceptance is to be called."""
        return self._index.next_number

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """Digests of what is not to be taken again."""
        return self._index.withdrawn

    def load(self) -> list[Accepted]:
        """What is there, the one in use last; damaged files are passed over."""
        found = []
        for entry in self._index.entries:
            try:
                data = read_whole(self._folder / entry.file, "weights file", MAX_BYTES)
                if digest_of(data) == entry.digest and decode_weights(data):
                    how = entry.proven, entry.accepted_utc_ns
                    found.append(Accepted(entry.number, entry.version, data, *how))
            except InputError:
                continue
        return found

    def keep(
        self, history: Sequence[Accepted], next_number: int, withdrawn: Sequence[str] = ()
    ) -> None:
        """Makes the folder hold these, the one in use last; InputError if it cannot."""
        known = {entry.number: entry for entry in self._index.entries}
        entries = []
        for one in trimmed([one for one in history if one.number]):
            entry = known.get(one.number) or self._written(one)
            entries.append(entry.model_copy(update={"proven": one.proven}))
        before = {entry.file for entry in self._index.entries}
        index = self._index.model_copy(
            update={
                "next_number": next_number,
                "entries": tuple(entries),
                "withdrawn": tuple(withdrawn)[-WITHDRAWN:],
            }
        )
        self._write_index(index)
        self._index = index  # not before: what the folder holds is what its own index says
        for name in before - {entry.file for entry in entries}:
            with suppress(OSError):  # it is in nobody's way
                (self._folder / name).unlink(missing_ok=True)

    def _written(self, one: Accepted) -> _Entry:
        digest = digest_of(one.data)
        name = f"{one.number:06d}-{digest[:12]}.bin"
        self._write(name, one.data)
        return _Entry(
            number=one.number,
            version=one.version,
            file=name,
            digest=digest,
            proven=one.proven,
            accepted_utc_ns=one.accepted_utc_ns,
        )

    def _write_index(self, index: _Index) -> None:
        self._write(_INDEX, (index.model_dump_json(indent=1) + "\n").encode())

    def _write(self, name: str, data: bytes) -> None:
        target = self._folder / name
        try:
            write_whole(target, data)
        except OSError as error:
            raise InputError(f"store {target}: {error.strerror or error}") from None
