"""Where a recording is damaged: the offset of the first record that is cut, or that can't be what it should be."""

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rosbags.rosbag2.storage_mcap import decompress

MCAP_MAGIC = b"\x89MCAP0\r\n"
ROS1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"

CHUNK, FOOTER = 0x06, 0x02
"""Opcodes of MCAP."""

ROS1_MAX_HEADER = 1 << 20
"""Bytes; a header has a few short fields, and the text of a message definition in a connection's."""


class Damage(NamedTuple):
    """A file that is damaged, the offset of its first bad record, and what may mend it."""

    file: Path
    offset: int
    remedy: str


def damage(path: Path) -> Damage | None:
    """Return the first damage of a recording's files, which are read to the end; None if none is found."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    return next((found for file in files if (found := _of_file(file)) is not None), None)


def _of_file(file: Path) -> Damage | None:
    with file.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        suffix = file.suffix.lower()
        if suffix == ".mcap":
            offset, remedy = _mcap(stream, size), f"`mcap recover {file} -o mended.mcap` keeps what is whole"
        elif suffix == ".bag":
            offset, remedy = _ros1(stream, size), f"`rosbag reindex {file}` keeps what is whole"
        elif suffix == ".db3":
            offset, remedy = (
                _sqlite(stream, size),
                f"`sqlite3 {file} .recover | sqlite3 mended.db3` keeps what is whole",
            )
        else:
            return None
    return None if offset is None else Damage(file, offset, remedy)


def _mcap(stream: BinaryIO, size: int) -> int | None:
    """Walk the records: an opcode, a length in 8 bytes, the record. A chunk's checksum is compared if it has no
    compression."""
    if stream.read(8) != MCAP_MAGIC:
        return 0
    at = 8
    while at < size:
        stream.seek(at)
        head = stream.read(9)
        if len(head) < 9:
            return at
        opcode, length = struct.unpack("<BQ", head)
        if opcode == 0 or at + 9 + length > size:
            return at
        if opcode == CHUNK and not _whole_chunk(stream, length):
            return at
        at += 9 + length
        if opcode == FOOTER:
            stream.seek(at)
            return None if stream.read(8) == MCAP_MAGIC else at
    return at


def _whole_chunk(stream: BinaryIO, length: int) -> bool:
    head = stream.read(32)
    if length < 40 or len(head) < 32:
        return False
    size, checksum, named = struct.unpack("<QII", head[16:])
    if named > length - 40:
        return False
    compression, packed = stream.read(named), struct.unpack("<Q", stream.read(8))[0]
    if packed != length - 40 - named:
        return False
    return _unpacks(compression, stream.read(packed), size, checksum)


def _unpacks(compression: bytes, packed: bytes, size: int, checksum: int) -> bool:
    if compression not in {b"", b"lz4", b"zstd"}:
        return True
    try:
        decompress(packed, compression.decode(), size, checksum)
    except Exception:  # noqa: BLE001 - what unpacks raises almost anything for bad bytes
        return False
    return True


def _ros1(stream: BinaryIO, size: int) -> int | None:
    """Walk the records: the length of the header in 4 bytes, its fields, the length of the data, the data."""
    if stream.read(len(ROS1_MAGIC)) != ROS1_MAGIC:
        return 0
    at = len(ROS1_MAGIC)
    while at < size:
        stream.seek(at)
        length = int.from_bytes(stream.read(4), "little")
        header = stream.read(length) if length <= ROS1_MAX_HEADER else b""
        data = stream.read(4)
        ends = at + 8 + length + int.from_bytes(data, "little")
        if len(data) < 4 or b"op=" not in header or ends > size:
            return at
        at = ends
    return None


def _sqlite(stream: BinaryIO, size: int) -> int | None:
    """Compare the size with the number of pages in the header; what else is damaged, SQLite says."""
    head = stream.read(100)
    if head[:16] != SQLITE_MAGIC or len(head) < 100:
        return 0
    page, pages = struct.unpack(">H", head[16:18])[0], struct.unpack(">I", head[28:32])[0]
    whole = (65536 if page == 1 else page) * pages
    return size if size < whole else None
