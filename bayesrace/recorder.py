"""Records every message of a car in a log that stays readable if this process dies.

What is written is handed to the system every 0.2 s: a killed process loses at most that.
"""

import logging
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

import zenoh

from bayesrace.errors import InputError
from bayesrace.log_rotation import RotatingLog
from bayesrace.messages import (
    EVENT,
    EVERYTHING,
    HEARTBEAT,
    Event,
    Numbering,
    car_key,
    encode,
    topic_of,
)
from bayesrace.scene import Scene

__all__ = ["FLUSH_PERIOD_S", "Recorder", "RecorderCounters"]

_log = logging.getLogger("bayesrace.recorder")

FLUSH_PERIOD_S: Final = 0.2
_BATCH_S: Final = 0.002
"""Between two batches of messages ..."""
_LONG_BATCH_S: Final = 0.05
"""... and in lockstep: fewer interruptions of what is recorded, and code that is in the caches."""
_REAL_TIME_HZ: Final = 3000
"""More messages a second than real time brings (four a cycle, at 500 Hz): it is lockstep."""
_CHANNEL_CAPACITY: Final = 1 << 13
_MOST_OTHER_KEYS: Final = 256
"""Keys that are not in the table of messages; the format has room for 65,535."""


@dataclass(slots=True)
class RecorderCounters:
    """Counts of a recorder's messages."""

    written: int = 0
    missing: int = 0
    """Messages that were sent, by their numbers (:class:`.Numbering`), and did not arrive."""
    unnumbered: int = 0
    """What is not a message of its key's topic; it is written all the same."""
    unrecorded: int = 0
    """Messages that are not written, since they came on too many keys that are not in the table."""
    parts_deleted: int = 0
    """Parts of the log that were deleted, the oldest first, to keep within its size."""


class Recorder:
    """Writes every message of a car (``bayesrace/{car}/**``) from a thread of its own.

    ``publish_time`` in the log is that of writing, some milliseconds after arrival; the messages
    carry the times at which they were made.
    Its channel holds more than any stall needs and then blocks the senders: in lockstep it never
    loses a message. ``with`` it; on the way out it waits for stragglers and finishes the file.
    """

    def __init__(
        self,
        session: Any,
        car: str,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        most_bytes: int | None = None,
        scene: Scene | None = None,
    ) -> None:
        """``most_bytes``: size of the log at most, of which the newest part is kept; None: no
        limit. ``scene``: written beside the messages."""
        self.counters = RecorderCounters()
        self.failed = ""
        """Why the log cannot be written; empty while it can. Later messages are not written."""
        self.gaps: list[str] = []
        """The first 20 gaps in the numbering, as text."""
        self._numbering: dict[str, Numbering] = {}
        self._other_keys: set[str] = set()
        self._path, self._session = path, session
        self._event_key = car_key(EVENT.key, car, "recorder")
        self._writer = RotatingLog(path, metadata, most_bytes, scene)
        self._lock = threading.Lock()
        self._subscriber = session.declare_subscriber(
            car_key(EVERYTHING, car), zenoh.handlers.FifoChannel(_CHANNEL_CAPACITY)
        )
        self._quiet_since_ns = time.monotonic_ns()
        self._writing = False
        """A message is on its way to the disk, which may hold it up."""
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, name=f"recorder-{name}", daemon=True)
            for name, run in (("write", self._write_all), ("flush", self._flush_often))
        ]
        for thread in self._threads:
            thread.start()

    def drain(self, quiet_s: float = 0.1, at_most_s: float = 2.0) -> None:
        """Wait until nothing but heartbeats has arrived for a while; all else is in the file then.

        Raises InputError if the log cannot be written any more, such as on a full disk.
        """
        give_up_ns = time.monotonic_ns() + int(at_most_s * 1e9)
        while (now_ns := time.monotonic_ns()) < give_up_ns:
            if not self._writing and now_ns - self._quiet_since_ns >= quiet_s * 1e9:
                break
            time.sleep(quiet_s / 5)
        self._flush()
        if self.failed:
            raise InputError(self.failed)

    def close(self, patience_s: float = 2.0) -> None:
        """Wait for stragglers, stop, finish the file; a second call does nothing."""
        if self._stop.is_set():
            return
        try:
            self.drain(at_most_s=patience_s)
        finally:
            self._stop.set()
            self._subscriber.undeclare()
            for thread in self._threads:
                thread.join()
            if self.counters.unrecorded:
                _log.warning(
                    "%s: %d messages on more than %d keys of other programs were not recorded",
                    self._path, self.counters.unrecorded, _MOST_OTHER_KEYS,
                )  # fmt: skip
            counted = {name: str(count) for name, count in asdict(self.counters).items()}
            with suppress(OSError, ValueError):
                self._writer.add_metadata("recorder", counted)
            with suppress(OSError, ValueError):
                self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_all(self) -> None:
        handler = self._subscriber.handler  # undeclare() fails while the subscriber is borrowed
        looked_ns = time.monotonic_ns()
        with suppress(zenoh.ZError):  # undeclared and drained
            while True:
                sample, count = handler.recv(), 0
                self._writing = True
                while sample is not None:
                    self._write(sample)
                    sample, count = handler.try_recv(), count + 1
                self._writing = False
                now_ns = time.monotonic_ns()
                lockstep = count > _REAL_TIME_HZ * 1e-9 * (now_ns - looked_ns)
                looked_ns = now_ns
                # Waking once a batch, not once a message, leaves the CPU to what is recorded.
                time.sleep(_LONG_BATCH_S if lockstep else _BATCH_S)

    def _write(self, sample: Any) -> None:
        now_ns = time.monotonic_ns()
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        topic = topic_of(key)
        if topic is not HEARTBEAT:  # those never end
            self._quiet_since_ns = now_ns
        if topic is None and key not in self._other_keys:
            if len(self._other_keys) == _MOST_OTHER_KEYS:
                self.counters.unrecorded += 1
                return
            self._other_keys.add(key)
        if self.failed:
            return
        try:
            with self._lock:
                seq = self._writer.write(key, data, now_ns)
            self._count(key, seq)
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Notes the failure in :attr:`failed`, and publishes one event about it."""
        if self.failed:
            return
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError):
            gone = isinstance(error, FileNotFoundError)
            why = "it has been deleted" if gone else f"{error.strerror}; make room and drive again"
        self.failed = f"cannot write the log {self._path}: {why}"
        now_ns = time.monotonic_ns()
        event = Event(
            seq=0,
            source_time_ns=now_ns,
            run=0,
            source="recorder",
            kind="recorder_failed",
            text=self.failed[:2000],
            data={},
        )
        # Not to this recorder's own channel, which may be full: put would block.
        with suppress(zenoh.ZError):
            self._session.put(
                self._event_key, encode(event), allowed_destination=zenoh.Locality.REMOTE
            )

    def _flush(self) -> None:
        try:
            with self._lock:
                self._writer.flush()
            # Writing to a deleted file succeeds, but its content is lost.
            self._writer.path.stat()
        except (OSError, ValueError) as error:
            self._fail(error)

    def _flush_often(self) -> None:
        while not self._stop.wait(FLUSH_PERIOD_S):
            self._flush()

    def _count(self, key: str, seq: int | None) -> None:
        counters = self.counters
        counters.written += 1
        counters.parts_deleted = self._writer.deleted
        if seq is None:
            counters.unnumbered += 1
            return
        if (numbering := self._numbering.get(key)) is None:
            numbering = self._numbering[key] = Numbering()
        before = numbering.lost
        numbering.note(seq)
        missing = numbering.lost - before  # below 0: a late message
        counters.missing += missing
        if missing > 0 and len(self.gaps) < 20:
            self.gaps.append(f"{key}: {missing} missing before {seq}")
