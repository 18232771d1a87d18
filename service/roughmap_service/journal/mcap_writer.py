"""Writing MCAP: the bytes of the mcap library's `Writer`, with few passes over large messages.

The library copies a message into the chunk, the chunk into a record, and sums both. Here a large message goes from its
own memory to the file, and is summed once.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from typing import IO, Protocol

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import LIBRARY_IDENTIFIER, MCAP0_MAGIC

from roughmap_service.journal.checksums import combined

LARGE_BYTES = 1 << 14
"""Messages from this size on are not copied."""

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence, log time, publish time."""

CHUNK_HEAD = struct.Struct("<BQQQQI")
"""Opcode, length of the rest, first and last log time, size and checksum of the records."""

COMPRESSIONS: dict[str, Callable[[bytes], bytes]] = {"lz4": lz4.frame.compress, "zstd": zstandard.compress}


class _Record(Protocol):
    def write(self, stream: RecordBuilder) -> None: ...


class McapWriter:
    """Writes a file to a stream: `start` first, `finish` last. ``compression``: "none", "lz4" or "zstd".

    A chunk ends when it holds more than ``chunk_bytes``, and at `flush`. Log times must rise. Only the stream raises
    errors; the file can't be continued after one.
    """

    def __init__(self, stream: IO[bytes], *, chunk_bytes: int, compression: str) -> None:
        self._stream = stream
        self._chunk_bytes = chunk_bytes
        self._compression = "" if compression == "none" else compression
        self._crc = 0  # of all bytes so far
        self._parts: list[bytes] = []  # of the chunk
        self._size = 0
        self._in_chunk: dict[int, list[tuple[int, int]]] = {}  # by channel: log times and places
        self._times: tuple[int, int] | None = None  # of the chunk: first and last
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first_time = self._last_time = 0

    def start(self, profile: str) -> None:
        """Write the beginning."""
        self._write(MCAP0_MAGIC)
        self._write(_bytes(Header(profile, LIBRARY_IDENTIFIER)))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        offset, record = self._stream.tell(), _bytes(Metadata(name=name, metadata=dict(values)))
        self._write(record)
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._add(_bytes(schema))
        return int(schema.id)

    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """Add a channel; return its number."""
        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding=message_encoding, schema_id=schema_id, metadata={}
        )  # fmt: skip
        self._channels.append(channel)
        self._add(_bytes(channel))
        return number

    def add_message(self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Add a message. Times are in ns."""
        self._first_time = self._first_time if self._counts else log_time
        self._last_time = log_time
        self._counts[channel] = self._counts.get(channel, 0) + 1
        self._times = (log_time if self._times is None else self._times[0]), log_time
        self._in_chunk.setdefault(channel, []).append((log_time, self._size))
        length = MESSAGE_HEAD.size - 9 + len(data)
        self._add(MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel, sequence, log_time, publish_time))
        self._add(data)
        if self._size > self._chunk_bytes:
            self._end_chunk()

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """End the chunk; write the summary and the footer. The stream stays open."""
        self._end_chunk()
        self._write(_bytes(DataEnd(self._crc)))
        summary, start = RecordBuilder(), self._stream.tell()
        offsets: list[SummaryOffset] = []
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._last_time,
            message_start_time=self._first_time,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        for opcode, records in (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata),
        ):
            begin = summary.count
            for record in records:
                record.write(summary)
            offsets.append(SummaryOffset(opcode, start + begin, summary.count - begin))
        offsets_at = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        footer = Footer(summary_start=start, summary_offset_start=offsets_at, summary_crc=0)
        footer.summary_crc = zlib.crc32(_bytes(footer)[:-4], zlib.crc32(data))
        self._write(data)
        self._write(_bytes(footer))
        self._write(MCAP0_MAGIC)

    def _add(self, part: bytes) -> None:
        self._parts.append(part)
        self._size += len(part)

    def _end_chunk(self) -> None:
        """Write the chunk and its index, if it has a message."""
        if self._times is None:
            return
        parts, crc = _joined(self._parts), 0
        for part in parts:
            crc = zlib.crc32(part, crc)
        size = stored = self._size
        if self._compression:
            parts = [COMPRESSIONS[self._compression](b"".join(parts))]
            stored = len(parts[0])
        name = self._compression.encode()
        rest = struct.pack(f"<I{len(name)}sQ", len(name), name, stored)
        length = CHUNK_HEAD.size - 9 + len(rest) + stored
        first, last = self._times
        offset = self._stream.tell()
        self._write(CHUNK_HEAD.pack(Opcode.CHUNK, length, first, last, size, crc) + rest)
        if self._compression:
            self._write(parts[0])
        else:
            for part in parts:
                self._stream.write(part)
            self._crc = combined(self._crc, crc, size)
        index_at, index, places = self._stream.tell(), RecordBuilder(), {}
        for channel, records in self._in_chunk.items():
            places[channel] = index_at + index.count
            MessageIndex(channel, records).write(index)
        indexed = index.end()
        self._write(indexed)
        self._chunks.append(
            ChunkIndex(
                message_start_time=first, message_end_time=last, chunk_start_offset=offset, chunk_length=9 + length,
                message_index_offsets=places, message_index_length=len(indexed), compression=self._compression,
                compressed_size=stored, uncompressed_size=size,
            )
        )  # fmt: skip
        self._parts, self._size, self._in_chunk, self._times = [], 0, {}, None

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)


def _bytes(record: _Record) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


def _joined(parts: list[bytes]) -> list[bytes]:
    """Join small parts that follow each other; large ones stay as they are."""
    joined: list[bytes] = []
    small: list[bytes] = []
    for part in parts:
        if len(part) < LARGE_BYTES:
            small.append(part)
        else:
            joined += [b"".join(small), part]
            small = []
    return [*joined, b"".join(small)]
