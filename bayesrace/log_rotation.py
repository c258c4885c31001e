"""A log whose size is limited: it goes on in new files, and the oldest are deleted."""

import secrets
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.log import LogReader, LogWriter
from bayesrace.log_parts import PART, part_files, part_path
from bayesrace.messages import EVENT, decode, topic_of
from bayesrace.scene import Scene

__all__ = ["RotatingLog"]

_PARTS: Final = 8
"""As many are there at most, the one that is written included. When one is full, the oldest are
deleted until there is room for two, the second one for what the last chunk and the index add."""

_REPEATED: Final = ("weights_accepted", "run")
"""Kinds of events that say what is driven: each part begins with the newest."""


class RotatingLog(LogWriter):
    """A log of as many bytes as wanted, in parts (:mod:`bayesrace.log_parts`).

    Each part has all metadata, and the newest announcements of weights and run: it can be read
    alone. Those of a recording that was there before under the same name are deleted. One thread
    only.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        most_bytes: int | None = None,
        scene: Scene | None = None,
    ) -> None:
        """``most_bytes``: of all parts together; None: no limit, one file. ``scene``: written
        beside the messages. InputError if the log cannot be written, or would replace a file that
        is no part of a recording."""
        for number, file in part_files(path).items():
            if number and LogReader(file).part:
                file.unlink(missing_ok=True)
            elif number and most_bytes is not None:
                raise InputError(f"{file} is no part of {path} and would be replaced; move it away")
        self.deleted = 0
        """Parts that are deleted."""
        self._first, self._metadata, self._most = path, dict(metadata or {}), most_bytes
        self._recording, self._number = secrets.token_hex(8), 0
        self._closed: deque[tuple[Path, int]] = deque()
        self._announced: dict[tuple[str, str], tuple[bytes, int]] = {}
        super().__init__(path, self._described(), scene)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Later parts have them, too."""
        self._metadata[name] = values
        super().add_metadata(name, values)

    def write(self, key: str, data: bytes, received_ns: int) -> int | None:
        """The part may be full with it, and the next one begin."""
        seq = super().write(key, data, received_ns)
        if self._most is not None:
            self._note(key, data, received_ns)
            if self.size_bytes >= self._most // _PARTS:
                self._rotate(self._most)
        return seq

    def _described(self) -> dict[str, Mapping[str, str]]:
        """The metadata at the beginning of a part."""
        if self._most is None:
            return self._metadata
        about = {
            "recording": self._recording, "number": str(self._number),
            "deleted": str(self.deleted), "repeated": str(len(self._announced)),
        }  # fmt: skip
        return {PART: about, **self._metadata}

    def _note(self, key: str, data: bytes, received_ns: int) -> None:
        """Keeps an announcement, in the order of arrival."""
        if topic_of(key) is EVENT:
            with suppress(InputError):
                if (kind := decode(EVENT.message, data).kind) in _REPEATED:
                    self._announced.pop((key, kind), None)
                    self._announced[key, kind] = data, received_ns

    def _rotate(self, most_bytes: int) -> None:
        self.close()
        self._closed.append((self.path, self.path.stat().st_size))
        while sum(size for _, size in self._closed) + 2 * (most_bytes // _PARTS) > most_bytes:
            oldest, _ = self._closed.popleft()
            oldest.unlink(missing_ok=True)
            self.deleted += 1
        self._number += 1
        self._begin(part_path(self._first, self._number), self._described())
        for (key, _), (data, received_ns) in self._announced.items():
            super().write(key, data, received_ns)
        self.flush()
