"""The MCAP file with the messages of a run: writer and reader.

Messages are JSON, one channel a key, with a JSON schema for each kind of message, in compressed
chunks with an index: Foxglove, Lichtblick and PlotJuggler open the file, and play it as fast as the
car drove, also what was simulated faster. Channels of a scene (:mod:`bayesrace.scene`) show viewers
how it looked; they hold no messages. :class:`LogReader` reads every whole chunk, also where the
file ends without its index.
"""

import json
import os
import struct
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Final, Generic, NamedTuple, TypeVar, cast

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Footer, Metadata
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from bayesrace.errors import InputError
from bayesrace.log_clock import CarClock
from bayesrace.log_parts import PART, part_files, part_path
from bayesrace.messages import (
    TOPICS,
    Message,
    Topic,
    decode,
    decode_json,
    json_schema,
    to_json,
    topic_of,
)
from bayesrace.scene import SCENE, Drawn, Scene, schema_name, schema_text

__all__ = ["Entry", "LogReader", "LogWriter"]

M = TypeVar("M", bound=Message)

_LARGEST_RECORD: Final = 1 << 27
_MOST_UNPACKED, _RATIO = 1 << 26, 200
"""Bytes that all chunks of a log may unpack to: so many, and this multiple of the file."""
_DAMAGED: Final = (
    McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError
)  # fmt: skip
"""What unpacking raises at a file that is cut off or spoilt."""
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_LAYOUT: Final = "foxglove-layout.json"


class LogWriter:
    """Appends messages and metadata to an MCAP file. One thread only.

    ``log_time`` is car time (:class:`.CarClock`), ``publish_time`` calendar time of the arrival.
    What is not a message of its key's topic stays as it was received, on a channel with the message
    encoding ``msgpack`` and no schema.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        scene: Scene | None = None,
    ) -> None:
        """``scene``: written beside the messages, with a layout as an attachment. InputError if the
        file cannot be written."""
        self._scene = scene
        # MCAP tools show calendar time; intervals stay those of the monotonic clock.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._clock = CarClock()
        self._begin(path, metadata or {})

    def _begin(self, path: Path, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """A file, in which car time goes on."""
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise InputError(f"cannot write the log {path}: {error.strerror}") from None
        self.path = path
        self._writer = Writer(self._file)
        self._writer.start(library="bayesrace")
        self._channels: dict[tuple[str, bool], int] = {}
        self._schemas: dict[str, int] = {}
        for name, values in metadata.items():
            self._writer.add_metadata(name, dict(values))
        if self._scene is not None:
            self._scene.begin()
            layout = _LAYOUT, "application/json", self._scene.layout
            self._writer.add_attachment(0, time.time_ns(), *layout)
        self.flush()

    @property
    def size_bytes(self) -> int:
        """Of the file, without the chunk that is not ended yet."""
        return self._file.tell()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A named map of texts, such as the settings or the manifest."""
        self._writer.add_metadata(name, dict(values))

    def write(self, key: str, data: bytes, received_ns: int) -> int | None:
        """One message as received on ``key`` at monotonic time ``received_ns``.

        Returns its number; None if it is not a message of the key's topic.
        """
        topic, message = topic_of(key), None
        with suppress(InputError):
            message = decode(topic.message, data) if topic else None
        place = key, message is None
        if place not in self._channels:
            encoding = "msgpack" if message is None else "json"
            schema = 0 if message is None else self._message_schema(type(message))
            self._channels[place] = self._writer.register_channel(key, encoding, schema)
        wall_ns = self._epoch_ns + received_ns
        time_ns = self._clock.time_ns(message, wall_ns, key.rpartition("/")[0])
        seq = None if message is None else message.seq
        content = data if message is None else to_json(message)
        number = 0 if seq is None else seq & 0xFFFFFFFF
        self._writer.add_message(self._channels[place], time_ns, content, wall_ns, number)
        if message is not None and self._scene is not None:
            for drawn in self._scene.of(key, message, time_ns):
                self._writer.add_message(self._scene_channel(drawn), time_ns, drawn.json, wall_ns)
        return seq

    def _scene_channel(self, drawn: Drawn) -> int:
        place = drawn.topic, False
        if place not in self._channels:
            kind = type(drawn.message)
            schema = self._schema(schema_name(kind), lambda: schema_text(kind))
            self._channels[place] = self._writer.register_channel(drawn.topic, "json", schema)
        return self._channels[place]

    def _message_schema(self, kind: type[Message]) -> int:
        return self._schema(kind.__name__, lambda: json.dumps(json_schema(kind)).encode())

    def _schema(self, name: str, text: Callable[[], bytes]) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text())
        return self._schemas[name]

    def flush(self) -> None:
        """End the chunk and hand it to the system, which keeps it when this process dies."""
        self._writer.flush()

    def close(self) -> None:
        """Finish the file with its index; :class:`LogReader` reads it without the index too."""
        if not self._file.closed:
            try:
                self._writer.finish()
            finally:
                self._file.close()


@dataclass(frozen=True, slots=True)
class Entry(Generic[M]):
    """One message of a log."""

    key: str
    log_time_ns: int
    """Car time: what was driven until then, after the log's first message [ns since 1970]."""
    wall_ns: int
    """Calendar time at the recorder [ns since 1970]."""
    message: M


class _Channel(NamedTuple):
    """The messages of one key in a log."""

    key: str
    topic: Topic[Any]
    decode: Callable[[type[Message], bytes], Message]


@dataclass
class _Place:
    """How far a log has been read, and what has been found on the way there."""

    number: int = 0
    """Of the part (:mod:`bayesrace.log_parts`) ..."""
    offset: int = 0
    """... and within it."""
    unpacked: int = 0
    """Bytes of its whole chunks."""
    repeated: int = 0
    """Messages at its beginning that are still to be left out."""
    pending: deque[Any] = field(default_factory=deque)
    """Records of the last chunk that have not been taken yet."""
    ended: bool = False
    """The end mark of the part has been read."""
    channels: dict[int, _Channel] = field(default_factory=dict)
    scene: set[int] = field(default_factory=set)
    """Numbers of the part's channels that hold no messages, but a scene."""
    refused: int = 0
    """Messages that could not be decoded."""

    def move_to(self, number: int, repeated: int) -> None:
        """To the beginning of another part."""
        self.number, self.repeated = number, repeated
        self.offset = self.unpacked = 0
        self.ended = False
        self.scene.clear()

    def of_messages(self, record: Any) -> bool:
        """Whether it is no part of a scene."""
        if isinstance(record, Channel) and record.topic.startswith(SCENE):
            self.scene.add(record.id)
            return False
        return not (isinstance(record, Record) and record.channel_id in self.scene)


class LogReader:
    """Reads a log in order of arrival, also one that was cut off, or is being written.

    A recording in parts is one log: they are read in order, from the oldest one that is there.
    After an iteration, ``refused`` and ``last_reason`` say what could not be decoded on its way
    from the beginning of the log, and ``truncated`` whether a file ends without its end mark.
    """

    def __init__(self, path: Path) -> None:
        """``path``: of the log; of a recording in parts, of the first one, though it be deleted, or
        of the one to be read alone."""
        if not (parts := part_files(path)):
            raise InputError(f"no log at {path}")
        self.path = path
        self.refused = 0
        self.last_reason = ""
        self.truncated = False
        self._first = next(iter(parts))
        self.part = self._about(self._first)
        """Which recording it is a part of, as the file says where reading begins; else empty."""
        self._place = _Place(self._first)

    @property
    def parts_gone(self) -> int:
        """Parts of the recording before the first message that is read."""
        return _count(self.part.get("number", ""))

    @property
    def overwritten(self) -> bool:
        """Whether another log is being written in place of what has been read by :meth:`newer`."""
        with suppress(OSError):
            part = part_path(self.path, self._place.number)
            return part.stat().st_size < self._place.offset
        return False

    def contents(self) -> tuple[set[str], dict[str, dict[str, str]]]:
        """:meth:`channels` and :meth:`metadata`, which take a whole reading each."""
        keys: set[str] = set()
        metadata: dict[str, dict[str, str]] = {}
        for record in self._records(_Place(self._first)):
            if isinstance(record, Channel):
                keys.add(record.topic)
            elif isinstance(record, Metadata):
                metadata[record.name] = dict(record.metadata)
        return keys, metadata

    def metadata(self) -> dict[str, dict[str, str]]:
        """Name to map of texts; the last of one name wins."""
        return self.contents()[1]

    def channels(self) -> set[str]:
        """The keys that it holds messages of."""
        return self.contents()[0]

    def messages(self, topics: Collection[Topic[Any]] = TOPICS) -> Iterator[Entry[Any]]:
        """The messages of these topics, typed; those that cannot be decoded are counted.

        They are read from the beginning, whatever :meth:`newer` has returned.
        """
        return self._entries(_Place(self._first), topics)

    def newer(self, topics: Collection[Topic[Any]] = TOPICS) -> Iterator[Entry[Any]]:
        """The messages of these topics in what has been added to the log since the last call.

        Where an iteration was left early, the next call continues after the last message taken.
        """
        return self._entries(self._place, topics)

    def _entries(self, place: _Place, topics: Collection[Topic[Any]]) -> Iterator[Entry[Any]]:
        self.refused = place.refused
        channels = place.channels
        wanted = {number: one for number, one in channels.items() if one.topic in topics}
        for record in self._records(place):
            if isinstance(record, Channel):
                topic = topic_of(record.topic)
                # The number may have been that of another key in the part before.
                wanted.pop(record.id, None)
                channels.pop(record.id, None)
                if topic is None:
                    continue
                form = decode_json if record.message_encoding == "json" else decode
                channels[record.id] = _Channel(record.topic, topic, form)
                if topic in topics:
                    wanted[record.id] = channels[record.id]
            elif isinstance(record, Record) and record.channel_id in wanted:
                channel = wanted[record.channel_id]
                try:
                    message = channel.decode(channel.topic.message, record.data)
                except InputError as error:
                    place.refused += 1
                    self.refused = place.refused
                    self.last_reason = str(error)
                    continue
                yield Entry(channel.key, record.log_time, record.publish_time, message)

    def select(self, topic: Topic[M]) -> list[M]:
        """All messages of one topic."""
        return [entry.message for entry in self.messages((topic,))]

    def _records(self, place: _Place) -> Iterator[Any]:
        """What follows that place, which moves on with each whole record or chunk, and from part
        to part."""
        self.truncated = False
        while True:
            # Looked for first: if there is a later part, no more is written to this one.
            later = self._later(place.number)
            for record in self._of_part(place):
                if place.repeated and isinstance(record, Record):
                    place.repeated -= 1
                    continue
                yield record
            if later is None:
                return
            number, repeated = later
            went_on = place.offset > 0 and number == place.number + 1
            place.move_to(number, repeated if went_on else 0)

    def _later(self, number: int) -> tuple[int, int] | None:
        """The next part of the same recording that is there, and how many messages it repeats;
        None while its beginning is not written."""
        if not self.part:
            return None
        for other in part_files(self.path):
            about = self._about(other) if other > number else {}
            if about and about.get("recording") == self.part.get("recording"):
                return other, _count(about.get("repeated", ""))
        return None

    def _about(self, number: int) -> dict[str, str]:
        """The metadata ``part`` of a file, which come before its messages; empty without."""
        with suppress(InputError):
            for record in self._of_part(_Place(number)):
                if isinstance(record, Metadata) and record.name == PART:
                    return dict(record.metadata)
                if isinstance(record, Channel | Record):
                    break
        return {}

    def _of_part(self, place: _Place) -> Iterator[Any]:
        """What follows that place in its part; nothing where that is deleted meanwhile."""
        path = part_path(self.path, place.number)
        while place.pending:
            yield place.pending.popleft()
        if place.ended:
            return
        try:
            file = path.open("rb")
        except FileNotFoundError:
            return
        with file:
            head = file.read(len(_MCAP_MAGIC))
            if not _MCAP_MAGIC.startswith(head):
                raise InputError(
                    f"{path} is not an MCAP log; give the log of a run, or make one of a drive of "
                    "others with 'bayesrace import-drive'"
                )
            file.seek(place.offset)
            reader = StreamReader(
                cast(Any, _Whole(file)),
                skip_magic=place.offset > 0,
                emit_chunks=True,
                record_size_limit=_LARGEST_RECORD,
            )
            try:
                for record in reader.records:
                    contained = self._contained(record, place, file)
                    place.pending.extend(filter(place.of_messages, contained))
                    # Not beyond the footer: the end mark behind it may not be written yet.
                    if not isinstance(record, Footer):
                        place.offset = file.tell()
                    while place.pending:
                        yield place.pending.popleft()
                place.ended = True
            except InputError:
                raise
            except _DAMAGED:
                self.truncated = True

    def _contained(self, record: Any, place: _Place, file: IO[bytes]) -> list[Any]:
        """The records of a chunk, which are counted if it is whole; any other record itself."""
        if not isinstance(record, Chunk):
            return [record]
        total = place.unpacked + record.uncompressed_size
        if total > _MOST_UNPACKED + _RATIO * os.fstat(file.fileno()).st_size:
            raise InputError(f"{file.name} would unpack to many times its size: no log of a run")
        records: list[Any] = breakup_chunk(_unpacked(record), validate_crc=True)
        place.unpacked = total
        return records


def _count(text: str) -> int:
    """A number in the metadata; 0 if it is none."""
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk, uncompressed; ValueError if its length is not the one that it states."""
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
