"""Which weights have been accepted, in which order; and the folder that keeps them.

The folder holds a file for each set of weights, and ``index.json`` with everything else of the
history. Every file appears whole or not at all.
"""

import hashlib
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.errors import InputError
from bayesrace.files import read_text, read_whole, write_whole
from bayesrace.gp.weights import decode_weights, pack_weights

__all__ = ["HISTORY", "AcceptedWeights", "History", "Store", "digest_of"]

HISTORY: Final = 8
"""Accepted weights that are kept."""
_WITHDRAWN: Final = 32
"""Digests of withdrawn weights that are kept."""

_INDEX: Final = "index.json"

_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def digest_of(data: bytes) -> str:
    """SHA-256 of a weights file's content, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


class AcceptedWeights(BaseModel):
    """Weights as the controller has accepted them."""

    model_config = ConfigDict(frozen=True)

    number: int = Field(ge=0, description="rises with each acceptance; 0: weights at the start")
    version: str
    digest: _Digest
    proven: bool = Field(description="not watched, or no longer")
    accepted_utc_ns: int = Field(0, ge=0, description="since 1970; 0: not known")
    data: bytes = Field(b"", exclude=True, repr=False, description="empty: without correction")
    packed: bytes = Field(b"", exclude=True, repr=False, description="arrays of the compiled step")

    @property
    def file(self) -> str:
        """Name of the file in the store."""
        return f"{self.number:06d}-{self.digest[:12]}.bin"


class History(BaseModel):
    """Accepted weights, the ones in use last; one set at least is proven. The store's index."""

    model_config = ConfigDict(extra="forbid")

    schema_version: Literal[1] = 1
    next_number: int = Field(1, ge=1)
    discretisation: str = Field("", description="of the controller that has accepted them")
    entries: list[AcceptedWeights] = []
    withdrawn: list[_Digest] = Field([], description="rolled back by the watch")

    @property
    def in_use(self) -> AcceptedWeights:
        """The weights in use."""
        return self.entries[-1]

    @property
    def reference(self) -> AcceptedWeights:
        """The newest proven weights: the watch compares with them and returns to them."""
        return next(one for one in reversed(self.entries) if one.proven)

    def accept(self, version: str, data: bytes, packed: bytes, proven: bool) -> AcceptedWeights:
        """Puts new weights into use, under the next number."""
        new = AcceptedWeights(
            number=self.next_number, version=version, digest=digest_of(data), proven=proven,
            accepted_utc_ns=time.time_ns(), data=data, packed=packed,
        )  # fmt: skip
        self.next_number += 1
        reference, kept = self.reference, [*self.entries, new][-HISTORY:]
        self.entries = kept if any(one.proven for one in kept) else [reference, *kept]
        return new

    def prove(self) -> AcceptedWeights:
        """Marks the weights in use as proven."""
        new = self.in_use.model_copy(update={"proven": True})
        self.entries = [*self.entries[:-1], new][-HISTORY:]
        return new

    def roll_back(self, target: AcceptedWeights, withdraw: bool) -> None:
        """Returns to ``target``; ``withdraw``: later weights are not to be accepted again."""
        end = self.entries.index(target) + 1
        left, self.entries = self.entries[end:], self.entries[:end]
        if withdraw:
            self.withdrawn = [*self.withdrawn, *(one.digest for one in left)][-_WITHDRAWN:]


class Store:
    """The folder of one controller."""

    def __init__(self, folder: Path, discretisation: str) -> None:
        """InputError if it cannot be used or belongs to a controller that predicts otherwise."""
        self._folder, path = folder, folder / _INDEX
        self._index, why_not = History(discretisation=discretisation), ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._index = History.model_validate_json(read_text(path, "the store's index"))
        except OSError as error:
            why_not = str(error.strerror)
        except ValidationError:
            why_not = f"{_INDEX} is damaged; remove it"
        if self._index.discretisation != discretisation:
            why_not = f"holds weights for {self._index.discretisation}, not for {discretisation}"
        if why_not:
            raise InputError(f"store {folder}: {why_not}; choose another folder")
        # A folder that cannot be written is an error now, not while the car drives.
        self._write(_INDEX, self._index.model_dump_json(indent=1).encode())

    def restore(self, start: AcceptedWeights) -> History:
        """What an earlier controller has kept, after ``start``; damaged files are left out."""
        entries = [start]
        for one in self._index.entries:
            with suppress(InputError):
                data = read_whole(self._folder / one.file, "weights file", MAX_WEIGHTS_BYTES)
                packed = pack_weights(decode_weights(data))
                if digest_of(data) == one.digest:
                    entries.append(one.model_copy(update={"data": data, "packed": packed}))
        return self._index.model_copy(update={"entries": entries})

    def keep(self, history: History) -> None:
        """Makes the folder hold this history; InputError if it cannot."""
        entries = [one for one in history.entries if one.number]  # 0 has a file of its own
        files = {one.file: one.data for one in entries}
        there = {path.name for path in self._folder.glob("[0-9]*-*.bin")}
        for name in files.keys() - there:
            self._write(name, files[name])
        index = history.model_copy(update={"entries": entries})
        self._write(_INDEX, index.model_dump_json(indent=1).encode())
        for name in there - files.keys():
            with suppress(OSError):
                (self._folder / name).unlink(missing_ok=True)

    def _write(self, name: str, data: bytes) -> None:
        try:
            write_whole(self._folder / name, data)
        except OSError as error:
            raise InputError(f"store {self._folder / name}: {error.strerror or error}") from None
