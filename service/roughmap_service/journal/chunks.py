"""What a log file's bytes may make the reader allocate: no more than the file holds, or than a chunk of ours unpacks
to.

A damaged length, or a file made to do harm, may say anything; the library takes it at its word.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import breakup_chunk

MAX_RECORDS = 200_000
"""Records of one chunk, each of which becomes an object: ours has some thousands, those of other tools ten times as
many."""

RECORD_HEAD = struct.Struct("<BQ")
"""With which each record begins: its kind and how many bytes follow."""


class BoundedFile:
    """A file of which no more is asked for than it holds: `read` allocates what it is asked for."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = os.fstat(stream.fileno()).st_size - stream.tell()

    def read(self, size: int) -> bytes:
        """At most ``size`` bytes; ValueError below 0, where a file would give all that it has."""
        if size < 0:
            raise ValueError("a record shorter than what it must hold")
        data = self._stream.read(min(size, self._left))
        self._left -= len(data)
        return data


def records_in(chunk: Chunk, most: int) -> Iterator[McapRecord]:
    """A chunk's records, its checksum verified. ValueError, or what the libraries raise, if it is damaged or unpacks to
    more than ``most`` bytes."""
    size = chunk.uncompressed_size
    if size > most:
        raise ValueError(f"a chunk of {size} bytes (at most {most})")
    data = _unpacked(chunk)
    if len(data) != size:
        raise ValueError(f"a chunk of {size} bytes has {len(data)}")
    at = number = 0
    while at < size:
        number += 1
        head = at + RECORD_HEAD.size
        at = head + RECORD_HEAD.unpack_from(data, at)[1] if head <= size else head
        if number > MAX_RECORDS or at > size:
            raise ValueError(f"a chunk of more than {MAX_RECORDS} records, or whose last is cut off")
    yield from breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)


def _unpacked(chunk: Chunk) -> bytes:
    """Its data; no more is unpacked than it says that it has."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (-1, size):  # -1: the frame doesn't tell
            raise ValueError(f"a chunk of {size} bytes unpacks to another size")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        return data
    if chunk.compression:
        raise ValueError(f"a chunk compressed by {chunk.compression[:20]!r}")
    return bytes(chunk.data)
