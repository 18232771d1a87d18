"""Reading one log file, in file order, with one chunk in memory at a time."""

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, cast

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from roughmap_schemas import Config, ContractError, Keys, RunMetadata, decode_event
from roughmap_schemas.faults import ReportedError
from roughmap_schemas.kinds import INPUTS, Kind
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.channels import parse_topic
from roughmap_service.journal.chunks import BoundedFile, records_in
from roughmap_service.journal.records import EventRecord, FileStart, InputRecord, LogItem

MAGIC = bytes([137, 77, 67, 65, 80, 48, 13, 10])
"""First bytes of every MCAP file, and last bytes of one that was closed."""

SUMMARY = struct.Struct("<QQI")
"""What precedes the last magic: start of the summary, start of its offset section, checksum from the former on."""

NOT_MCAP = "not an MCAP file"

MAX_RECORD_BYTES = 1 << 30
"""The largest record that is read: a damaged length must not become an allocation."""

LAST_OPCODE = bytes([Opcode.DATA_END])
"""The largest opcode of a record; they are numbered from 1."""

LEAST_UNPACKED = 65 << 20
"""Bytes that a chunk may always unpack to: the default of input.max_message, and 1 MiB for small records beside it."""

_DAMAGE = (McapError, struct.error, ValueError, zlib.error, zstandard.ZstdError, RuntimeError, KeyError)
"""What the libraries raise over damaged bytes."""


class LogError(ReportedError):
    """A log that can't be read; one line that names the file and the cause."""

    exit_code = 2


class DamagedLog(LogError):
    """A file whose bytes are not what was written, although it was closed, or whose beginning is damaged."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path


class TornLog(LogError):
    """A file that ends before its footer, as after a kill. Everything before the tear was already yielded."""


def is_closed(path: Path) -> bool:
    """Return whether a file ends like one that was closed. Such a file is never appended to."""
    with path.open("rb") as stream:
        if stream.seek(0, os.SEEK_END) < 2 * len(MAGIC):
            return False
        stream.seek(-len(MAGIC), os.SEEK_END)
        return stream.read() == MAGIC


def has_summary(path: Path) -> bool:
    """Return whether the summary of a closed file matches its checksum. Other readers find their way by the summary."""
    with path.open("rb") as stream:
        end = stream.seek(0, os.SEEK_END) - SUMMARY.size - len(MAGIC)
        if end < 0:
            return False
        stream.seek(end)
        start, _, checksum = SUMMARY.unpack(stream.read(SUMMARY.size))
        left, found = end + SUMMARY.size - 4 - stream.seek(min(start, end)), 0
        while left:
            data = stream.read(min(left, 1 << 20))
            found, left = zlib.crc32(data, found), left - len(data)
    return bool(found == checksum)


def raw_records(path: Path) -> Iterator[tuple[McapRecord, int]]:
    """Yield schemas, channels, messages and metadata of a file's data section in file order.

    Each comes with the position behind it in bytes; for a record in a chunk, that is behind the chunk. Checksums are
    verified. TornLog at a tear, DamagedLog at damage or if the file was not written by roughmap.
    """
    with path.open("rb") as stream:
        try:
            source = cast("IO[bytes]", BoundedFile(stream))  # the reader only calls `read`
            reader = StreamReader(source, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
            most = LEAST_UNPACKED
            for record in reader.records:
                end = stream.tell()
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk):
                    for inner in records_in(record, most):
                        yield inner, end
                elif isinstance(record, Schema | Channel | Message):
                    # Only chunks have checksums, and the writer puts these records into chunks.
                    raise ValueError("a record outside of all chunks: its opcode is damaged")
                else:
                    if isinstance(record, Metadata) and record.name == RECORD_NAME:
                        most = _most_unpacked(record)
                    yield record, end
                opcode = stream.peek(1)[:1]
                if opcode > LAST_OPCODE or opcode == b"\0":  # the library skips such records
                    raise ValueError("a record without a valid opcode, such as zeros left by a power cut")
        except EndOfFile:
            raise _end_of(path) from None
        except InvalidMagic:
            raise DamagedLog(path, NOT_MCAP) from None
        except _DAMAGE as error:
            if isinstance(error, struct.error | UnicodeDecodeError) and not stream.read(1):
                # The library reports an end between two fields as EndOfFile, but not an end within a field.
                raise _end_of(path) from None
            cause = str(error) or type(error).__name__
            raise DamagedLog(path, f"damaged at or before byte {stream.tell()}: {cause}") from None


def _most_unpacked(record: Metadata) -> int:
    """Return how many bytes a chunk may unpack to in a file with this metadata: one message, and 1 MiB beside it."""
    try:
        message = int(RunMetadata.from_record(record.metadata).configuration["input"]["max_message"])
    except (ContractError, KeyError, TypeError, ValueError):
        return LEAST_UNPACKED  # a caller that needs the metadata finds the error itself
    return min(max(LEAST_UNPACKED, message + (1 << 20)), MAX_RECORD_BYTES)


def _end_of(path: Path) -> LogError:
    """Return the error for a file whose last record is longer than what is left of the file."""
    if is_closed(path):
        return DamagedLog(path, "damaged: a record is longer than the rest of the file, although the file was closed")
    with path.open("rb") as stream:
        begun = MAGIC.startswith(stream.read(len(MAGIC)))
    return TornLog(f"{path}: {'the file ends before its footer' if begun else NOT_MCAP}")


def read_metadata(path: Path) -> RunMetadata:
    """Return the metadata record at a file's beginning; LogError if there is none."""
    try:
        for record, _ in raw_records(path):
            if isinstance(record, Metadata) and record.name == RECORD_NAME:
                return RunMetadata.from_record(record.metadata)
            if isinstance(record, Message):
                break
    except ContractError as error:
        raise DamagedLog(path, str(error)) from None
    raise LogError(f"{path}: not a log of roughmap (its metadata record '{RECORD_NAME}' is missing)")


def last_log_time(path: Path) -> int:
    """Return the largest log time of a closed file's messages in ns, from its summary; 0 without a valid one."""
    try:
        if not has_summary(path):
            return 0
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (*_DAMAGE, MemoryError, OverflowError, OSError):  # impossible positions and lengths in the footer
        return 0
    return 0 if summary is None or summary.statistics is None else summary.statistics.message_end_time


def read_file(path: Path) -> Iterator[LogItem]:
    """Yield a file's beginning, inputs and events; skip outputs and foreign channels. Errors as `raw_records`."""
    metadata = read_metadata(path)
    try:
        config = Config.from_log(metadata.configuration)
    except ValueError as error:
        raise LogError(f"{path}: its configuration can't be read: {str(error).splitlines()[0]}") from None
    yield FileStart(path, metadata, config)
    keys = Keys(config.map.name, config.keys)
    topics: dict[int, tuple[Kind, str] | None] = {}
    number, position = metadata.first_input - 1, metadata.first_record - 1
    for record, _ in raw_records(path):
        if isinstance(record, Channel):
            topics[record.id] = parse_topic(record.topic, keys)
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic is None:
                continue
            position += 1
            kind, robot = topic
            if kind in INPUTS:
                number += 1
                yield InputRecord(number, position, kind, robot, record.data, record.log_time, record.publish_time)
            else:
                try:
                    yield EventRecord(position, decode_event(record.data), record.log_time)
                except ContractError as error:
                    raise LogError(f"{path}: event at record {position}: {error}") from None
