"""Every message of a run in one MCAP file that is readable whatever happened to the writer.

Records are written one by one, not in chunks, and handed to the system at least every .2 s: a
killed process loses at most that, and the reader takes a file that ends anywhere.
"""

import json
import struct
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Final, Generic, Self, TypeVar, cast

import lz4.frame
import zenoh
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Metadata
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from bayesrace.errors import InputError
from bayesrace.messages import (
    EVENT,
    TOPICS,
    Decoder,
    Event,
    Message,
    Topic,
    car_key,
    encode,
    json_schema,
)
from bayesrace.messages.codec import peek_seq

__all__ = ["Entry", "LogReader", "LogWriter", "Recorder", "RecorderCounters"]

M = TypeVar("M", bound=Message)

FLUSH_PERIOD_S: Final = 0.2
_BATCH_S: Final = 0.002
_CHANNEL_CAPACITY: Final = 1 << 16
_MOST_KEYS: Final = 256
"""A log's own keys are eight; the format has room for 65,535."""
_LARGEST_RECORD: Final = 1 << 27
_MOST_UNPACKED, _RATIO = 1 << 26, 200
"""Bytes that all chunks of a log may unpack to: so many, and this multiple of the file."""
_DAMAGED: Final = (McapError, struct.error, ValueError, RuntimeError, zstandard.ZstdError)
"""What unpacking raises at a file that is cut off or spoilt."""
_MESSAGE_ENCODING: Final = "msgpack"
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_BY_PREFIX: Final = {topic.key.split("/")[2]: topic for topic in TOPICS}


def _topic_of(key: str) -> Topic[Any] | None:
    """The table's row for a key such as ``bayesrace/orca/state``; None for any other key."""
    parts = key.split("/")
    if len(parts) < 3 or parts[0] != "bayesrace":
        return None
    topic = _BY_PREFIX.get(parts[2])
    if topic is None or len(parts) != len(topic.key.split("/")):
        return None
    return topic


def _in_table(key: str) -> bool:
    """Whether the table has this very key, of whatever car."""
    topic, source = _topic_of(key), key.rsplit("/", 1)[-1]
    return topic is not None and ("{source}" not in topic.key or source in topic.sources)


class LogWriter:
    """Appends messages, as they were on the wire, and metadata to an MCAP file. One thread only."""

    def __init__(self, path: Path, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise InputError(f"cannot write the log {path}: {error.strerror}") from None
        self._writer = Writer(
            self._file,
            compression=CompressionType.NONE,
            index_types=IndexType.ALL,
            use_chunking=False,
        )
        self._writer.start(profile="", library="bayesrace")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        # MCAP tools show calendar time; intervals stay those of the monotonic clock.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        for name, values in (metadata or {}).items():
            self.add_metadata(name, values)
        self.flush()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A named map of texts, such as the settings or the manifest."""
        self._writer.add_metadata(name, dict(values))

    def write(self, key: str, data: bytes, received_ns: int, seq: int = 0) -> None:
        """One message as received on ``key`` at monotonic time ``received_ns``."""
        channel = self._channels.get(key)
        if channel is None:
            channel = self._register(key)
        time_ns = self._epoch_ns + received_ns
        self._writer.add_message(channel, time_ns, data, time_ns, seq)

    def _register(self, key: str) -> int:
        topic = _topic_of(key)
        schema = 0 if topic is None else self._schema(topic)
        channel: int = self._writer.register_channel(key, _MESSAGE_ENCODING, schema)
        self._channels[key] = channel
        return channel

    def _schema(self, topic: Topic[Any]) -> int:
        name = topic.message.__name__
        if name not in self._schemas:
            text = json.dumps(json_schema(topic.message)).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
        return self._schemas[name]

    def flush(self) -> None:
        """Hand everything to the system, where a dying process does not take it along."""
        self._file.flush()

    def close(self) -> None:
        """Finish the file with its index; the log is readable without this too."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()


@dataclass(slots=True)
class RecorderCounters:
    """What a recorder saw."""

    written: int = 0
    missing: int = 0
    """Messages that must have been sent, by their numbers, and did not arrive."""
    disordered: int = 0
    """Messages with a number not above the one before, restarts from 0 aside."""
    restarts: int = 0
    """Times that a sender began again at 0."""
    unnumbered: int = 0
    """Messages without a readable number; written all the same."""
    unrecorded: int = 0
    """Messages on more keys than a log has room for, let go."""


class Recorder:
    """Writes every message of a car (``bayesrace/{car}/**``) from a thread of its own.

    Log times are those of writing, some milliseconds after arrival; the messages carry the times
    at which they were made.
    Its channel holds more than any stall needs and then blocks the senders: in lockstep it never
    loses a message. ``with`` it; on the way out it waits for stragglers and finishes the file.
    """

    def __init__(
        self,
        session: Any,
        car: str,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self.counters = RecorderCounters()
        self.failed = ""
        """Why the log cannot be written; empty while it can. Messages are then let go."""
        self.gaps: list[str] = []
        """The first few gaps in the numbering, in words."""
        self._last: dict[str, int] = {}
        self._keys: set[str] = set()
        self._path, self._session = path, session
        self._event_key = car_key(EVENT.key, car, "recorder")
        self._writer = LogWriter(path, metadata)
        self._lock = threading.Lock()
        self._subscriber = session.declare_subscriber(
            car_key("bayesrace/{car}/**", car), zenoh.handlers.FifoChannel(_CHANNEL_CAPACITY)
        )
        self._quiet_since_ns = time.monotonic_ns()
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, name=f"recorder-{name}", daemon=True)
            for name, run in (("write", self._write_all), ("flush", self._flush_often))
        ]
        for thread in self._threads:
            thread.start()

    def settle(self, quiet_s: float = 0.1, at_most_s: float = 2.0) -> None:
        """Wait until nothing has arrived for a while; then all of it can be read from the file.

        Raises InputError if the log cannot be written any more, such as on a full disk.
        """
        give_up_ns = time.monotonic_ns() + int(at_most_s * 1e9)
        while (now_ns := time.monotonic_ns()) < give_up_ns:
            if now_ns - self._quiet_since_ns >= quiet_s * 1e9:
                break
            time.sleep(quiet_s / 5)
        self._flush()
        if self.failed:
            raise InputError(self.failed)

    def close(self) -> None:
        """Wait for stragglers, stop, finish the file; a second call does nothing."""
        if self._stop.is_set():
            return
        try:
            self.settle()
        finally:
            self._stop.set()
            self._subscriber.undeclare()
            for thread in self._threads:
                thread.join()
            with suppress(OSError, ValueError):
                self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_all(self) -> None:
        handler = self._subscriber.handler
        while True:
            try:
                sample = handler.recv()
                while sample is not None:
                    self._write(sample)
                    sample = handler.try_recv()
            except zenoh.ZError:  # undeclared and drained
                return
            # Waking for a batch instead of each message leaves the CPU to who is recorded.
            time.sleep(_BATCH_S)

    def _write(self, sample: Any) -> None:
        now_ns = time.monotonic_ns()
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        if not data:  # an inbox of the same session waking itself
            return
        self._quiet_since_ns = now_ns
        if not self._known(key):
            self.counters.unrecorded += 1
            return
        seq = peek_seq(data)
        self._account(key, seq)
        if self.failed:
            return
        try:
            with self._lock:
                self._writer.write(key, data, now_ns, 0 if seq is None else seq & 0xFFFFFFFF)
        except Exception as error:
            self._fail(error)

    def _known(self, key: str) -> bool:
        """Whether messages on this key are written: the table's, and a bounded number of others."""
        if key not in self._keys and (len(self._keys) < _MOST_KEYS or _in_table(key)):
            self._keys.add(key)
        return key in self._keys

    def _fail(self, error: Exception) -> None:
        """Notes the failure in :attr:`failed`, and publishes one event about it."""
        if self.failed:
            return
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError):
            why = f"{error.strerror}; make room and drive again"
        self.failed = f"cannot write the log {self._path}: {why}"
        now_ns = time.monotonic_ns()
        event = Event(0, now_ns, 0, "recorder", "recorder_failed", self.failed[:2000], {})
        with suppress(zenoh.ZError):
            # Not to itself, who takes nothing from its channel at this moment.
            self._session.put(
                self._event_key, encode(event), allowed_destination=zenoh.Locality.REMOTE
            )

    def _flush(self) -> None:
        try:
            with self._lock:
                self._writer.flush()
        except (OSError, ValueError) as error:
            self._fail(error)

    def _flush_often(self) -> None:
        while not self._stop.wait(FLUSH_PERIOD_S):
            self._flush()

    def _account(self, key: str, seq: int | None) -> None:
        counters = self.counters
        counters.written += 1
        if seq is None:
            counters.unnumbered += 1
            return
        last = self._last.get(key)
        self._last[key] = seq
        if last is None or seq == last + 1:
            return
        if seq == 0:
            counters.restarts += 1
        elif seq <= last:
            counters.disordered += 1
        else:
            counters.missing += seq - last - 1
            if len(self.gaps) < 20:
                self.gaps.append(f"{key}: {last + 1} to {seq - 1} missing")


@dataclass(frozen=True, slots=True)
class Entry(Generic[M]):
    """One message of a log."""

    key: str
    log_time_ns: int
    """Calendar time at the recorder [ns since 1970]."""
    message: M


class LogReader:
    """Reads a log in order of arrival, also one that was cut off.

    After an iteration, ``refused`` and ``last_reason`` say what could not be decoded, and
    ``truncated`` whether the file ends without its end mark.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"no log at {path}")
        self.path = path
        self.refused = 0
        self.last_reason = ""
        self.truncated = False

    def metadata(self) -> dict[str, dict[str, str]]:
        """Name to map of texts; the last of one name wins."""
        found = (record for record in self._records() if isinstance(record, Metadata))
        return {record.name: dict(record.metadata) for record in found}

    def messages(self, topics: Collection[Topic[Any]] = TOPICS) -> Iterator[Entry[Any]]:
        """The messages of these topics, typed; those that cannot be decoded are counted."""
        decoders = {topic.name: Decoder(topic.message) for topic in topics}
        channels: dict[int, tuple[str, Decoder[Any] | None]] = {}
        self.refused = 0
        for record in self._records():
            if isinstance(record, Channel):
                topic = _topic_of(record.topic)
                decoder = None if topic is None else decoders.get(topic.name)
                channels[record.id] = (record.topic, decoder)
            elif isinstance(record, Record):
                key, decoder = channels.get(record.channel_id, ("", None))
                if decoder is None:
                    continue
                message = decoder(record.data)
                if message is None:
                    self.refused += 1
                    self.last_reason = decoder.last_reason
                else:
                    yield Entry(key, record.log_time, message)

    def select(self, topic: Topic[M]) -> list[M]:
        """All messages of one topic."""
        return [entry.message for entry in self.messages((topic,))]

    def _records(self) -> Iterator[Any]:
        self.truncated = False
        with self.path.open("rb") as file:
            head = file.read(len(_MCAP_MAGIC))
            file.seek(0)
            if not _MCAP_MAGIC.startswith(head):
                raise InputError(f"{self.path} is not an MCAP log; give the log of a run")
            left = _MOST_UNPACKED + _RATIO * self.path.stat().st_size
            try:
                for record in StreamReader(
                    cast(Any, _Whole(file)), emit_chunks=True, record_size_limit=_LARGEST_RECORD
                ).records:
                    if not isinstance(record, Chunk):
                        yield record
                        continue
                    left -= record.uncompressed_size
                    if left < 0:
                        raise InputError(
                            f"{self.path} would unpack to many times its size: no log of a run"
                        )
                    yield from breakup_chunk(_unpacked(record))
            except InputError:
                raise
            except _DAMAGED:
                self.truncated = True


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk of another tool's log, uncompressed; ValueError if it is longer than it says."""
    size = chunk.uncompressed_size
    if size > _LARGEST_RECORD:
        raise ValueError("a chunk too large")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    else:
        data = chunk.data
    if len(data) != size:
        raise ValueError("a chunk of another length")
    return replace(chunk, compression="", data=data)


class _Whole:
    """A file whose reads give all the bytes asked for or end the file, never a part of a record."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, count: int) -> bytes:
        data = self._file.read(count)
        if len(data) < count:
            raise EndOfFile
        return data
