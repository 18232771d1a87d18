"""Reading the log back, in file order, with memory for one chunk at a time."""

import contextlib
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import IO, cast

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from roughmap_schemas import Config, ContractError, Event, Keys, MessageFault, RunMetadata, decode_event
from roughmap_schemas.faults import ReportedError
from roughmap_schemas.kinds import INPUTS, Kind
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.chunks import BoundedFile, records_in

MAGIC = bytes([137, 77, 67, 65, 80, 48, 13, 10])
"""With which an MCAP file begins, and ends if it was closed."""

SUMMARY = struct.Struct("<QQI")
"""What stands before that: where the summary begins, its part of offsets, and the checksum of all before it."""

NO_MCAP = "is no MCAP file"

MAX_RECORD_BYTES = 1 << 30
"""No record is larger; a damaged length must not become an allocation."""

KINDS = bytes([Opcode.DATA_END])
"""The last of the kinds of records, which are numbered from 1."""

LEAST_UNPACKED = 65 << 20
"""Bytes that a chunk may unpack to in any case: the default of input.max_message, and what lies beside it."""

_DAMAGE = (McapError, struct.error, ValueError, zlib.error, zstandard.ZstdError, RuntimeError, KeyError)
"""What the reader's libraries raise over bytes that are not what they should be."""


class LogError(ReportedError):
    """A log that can't be read as one; one line that names the file and what is wrong with it."""

    exit_code = 2


class DamagedLog(LogError):
    """A file whose bytes are not what was written, though it was closed in order, or its beginning is not."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path


class TornLog(LogError):
    """A file that ends before its footer, as after a kill. What stood before the tear was already given out."""


@dataclass(frozen=True, slots=True)
class FileStart:
    """The beginning of a file."""

    path: Path
    metadata: RunMetadata
    config: Config


@dataclass(frozen=True, slots=True)
class InputRecord:
    """A logged input. ``number`` counts from 1 over the run, ``record`` inputs and events together; times in ns."""

    number: int
    record: int
    kind: Kind
    robot: str
    payload: bytes
    received_ns: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class EventRecord:
    """A logged event."""

    record: int
    event: Event
    received_ns: int


LogItem = FileStart | InputRecord | EventRecord


def is_closed(path: Path) -> bool:
    """Whether a file ends as one that was closed; such a file is never appended to."""
    with path.open("rb") as stream:
        if stream.seek(0, os.SEEK_END) < 2 * len(MAGIC):
            return False
        stream.seek(-len(MAGIC), os.SEEK_END)
        return stream.read() == MAGIC


def has_summary(path: Path) -> bool:
    """Whether a closed file's summary, by which other readers find their way in it, is what was written (its checksum
    says so)."""
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
    """Schemas, channels, messages and metadata of a file's data section in file order, each with the byte behind it
    (of a record in a chunk: behind the chunk).

    TornLog at a tear, DamagedLog at damage (checksums are verified) or if the file is none of ours.
    """
    with path.open("rb") as stream:
        try:
            source = cast("IO[bytes]", BoundedFile(stream))  # of which the reader uses `read` alone
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
                    raise ValueError("a record outside of all chunks, which have the checksums: its kind is damaged")
                else:
                    if isinstance(record, Metadata) and record.name == RECORD_NAME:
                        most = _most_unpacked(record)
                    yield record, end
                kind = stream.peek(1)[:1]
                if kind > KINDS or kind == b"\0":  # the library passes over them
                    raise ValueError("a record of no kind, such as zeros that a power cut left for what was written")
        except EndOfFile:
            raise _end_of(path) from None
        except InvalidMagic:
            raise DamagedLog(path, NO_MCAP) from None
        except _DAMAGE as error:
            if isinstance(error, struct.error | UnicodeDecodeError) and not stream.read(1):
                # The library tells an end at a field's beginning from damage, but not one in the midst of a field.
                raise _end_of(path) from None
            raise DamagedLog(path, f"damaged at or before byte {stream.tell()}: {_told(error)}") from None


def _most_unpacked(record: Metadata) -> int:
    """Bytes that a chunk of a file that begins with this record may unpack to: one message, and what is small."""
    try:
        message = int(RunMetadata.from_record(record.metadata).configuration["input"]["max_message"])
    except (ContractError, KeyError, TypeError, ValueError):
        return LEAST_UNPACKED  # whoever needs the record finds that out by himself
    return min(max(LEAST_UNPACKED, message + (1 << 20)), MAX_RECORD_BYTES)


def _end_of(path: Path) -> LogError:
    """What it means that a file's records go on past its end."""
    if is_closed(path):
        return DamagedLog(path, "damaged: a record goes on past the end, though the file was closed in order")
    with path.open("rb") as stream:
        begun = MAGIC.startswith(stream.read(len(MAGIC)))
    return TornLog(f"{path}: {'the file ends before its footer' if begun else NO_MCAP}")


def _told(error: Exception) -> str:
    return str(error) or type(error).__name__


def read_metadata(path: Path) -> RunMetadata:
    """The metadata record at a file's beginning; LogError if the file has none."""
    try:
        for record, _ in raw_records(path):
            if isinstance(record, Metadata) and record.name == RECORD_NAME:
                return RunMetadata.from_record(record.metadata)
            if isinstance(record, Message):
                break
    except ContractError as error:
        raise DamagedLog(path, str(error)) from None
    raise LogError(f"{path}: no log of roughmap (its metadata record '{RECORD_NAME}' is missing)")


def last_log_time(path: Path) -> int:
    """The largest log time of a closed file's messages in ns, by its footer; 0 if it has none, or a damaged one."""
    try:
        if not has_summary(path):
            return 0
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (*_DAMAGE, MemoryError, OverflowError, OSError):  # of places and lengths in the footer that can't be
        return 0
    return 0 if summary is None or summary.statistics is None else summary.statistics.message_end_time


def read_file(path: Path) -> Iterator[LogItem]:
    """A file's beginning, inputs and events; outputs and foreign channels are passed over. Errors as `raw_records`."""
    metadata = read_metadata(path)
    try:
        config = Config.from_log(metadata.configuration)
    except ValueError as error:
        raise LogError(f"{path}: its configuration can't be read: {str(error).splitlines()[0]}") from None
    yield FileStart(path, metadata, config)
    keys = Keys(config.map.name, config.keys)
    roles: dict[int, tuple[Kind, str] | None] = {}
    number, position = metadata.first_input - 1, metadata.first_record - 1
    for record, _ in raw_records(path):
        if isinstance(record, Channel):
            roles[record.id] = role_of(record.topic, keys)
        elif isinstance(record, Message):
            role = roles.get(record.channel_id)
            if role is None:
                continue
            position += 1
            kind, robot = role
            if kind in INPUTS:
                number += 1
                yield InputRecord(number, position, kind, robot, record.data, record.log_time, record.publish_time)
            else:
                try:
                    yield EventRecord(position, decode_event(record.data), record.log_time)
                except ContractError as error:
                    raise LogError(f"{path}: event at record {position}: {error}") from None


def role_of(topic: str, keys: Keys) -> tuple[Kind, str] | None:
    """What a channel holds for the run, and of which robot; None for outputs and anything else."""
    if topic == keys.events:
        return Kind.EVENTS, ""
    for kind, parse in (
        (Kind.POINTS, keys.parse_points),
        (Kind.ODOMETRY, keys.parse_odometry),
        (Kind.TRANSFORM, keys.parse_transform),
    ):
        try:
            return kind, parse(topic)
        except MessageFault:
            continue
    return None


@dataclass(frozen=True, slots=True)
class RunFile:
    """A file and what its beginning says."""

    path: Path
    metadata: RunMetadata


def find_files(paths: Iterable[Path]) -> list[RunFile]:
    """The log files among files and folders, each once, ordered by run and index. LogError for a file that is none.

    A file in a folder whose beginning a kill kept from the disk holds nothing of any run, and is passed over.
    """
    found: dict[Path, RunFile] = {}
    for path in paths:
        try:
            if not path.is_dir():
                found[path.resolve()] = RunFile(path, read_metadata(path))
                continue
            for file in path.glob("*.mcap"):
                with contextlib.suppress(TornLog):
                    found[file.resolve()] = RunFile(file, read_metadata(file))
        except OSError as error:
            raise LogError(f"{error.filename or path}: {error.strerror or error}") from None
    return sorted(found.values(), key=lambda file: (file.metadata.run, file.metadata.index, file.path))


def one_run(files: Sequence[RunFile], found_in: Sequence[Path] = ()) -> list[RunFile]:
    """Check that the files, which were looked for in ``found_in``, are one run without a gap. LogError that names what
    is missing or too much."""
    if not files:
        raise LogError(f"no log files (*.mcap) in {', '.join(map(str, found_in)) or 'no folder'}")
    runs = sorted({file.metadata.run for file in files})
    if len(runs) > 1:
        raise LogError(f"logs of {len(runs)} runs ({', '.join(run[:8] for run in runs)}...): name those of one")
    for before, after in pairwise(files):
        number = before.metadata.index
        if after.metadata.index == number:
            raise LogError(f"{before.path} and {after.path} are both file {number} of run {runs[0][:8]}: name one")
        if after.metadata.index != number + 1:
            raise LogError(
                f"gap: file {number + 1} of run {runs[0][:8]} is missing "
                f"between {before.path.name} and {after.path.name}: put it back, or begin a new map by serve --fresh"
            )
    return list(files)


def read_run(files: Sequence[RunFile]) -> Iterator[LogItem]:
    """All items of a run's files in order.

    A tear is the end of the last file, and of one that was left behind because the disk failed: that nothing is
    missing is seen from the numbers with which the next file begins. LogError (gap) where something is.
    """
    number = position = 0
    for at, file in enumerate(files):
        first = file.metadata
        if at and (first.first_input, first.first_record) != (number + 1, position + 1):
            raise LogError(
                f"gap: {file.path.name} begins with input {first.first_input}, record {first.first_record}; "
                f"expected {number + 1}, {position + 1}"
            )
        number, position = first.first_input - 1, first.first_record - 1
        try:
            for item in read_file(file.path):
                if isinstance(item, InputRecord):
                    number, position = item.number, item.record
                elif isinstance(item, EventRecord):
                    position = item.record
                yield item
        except TornLog:
            continue
