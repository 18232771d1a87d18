"""Bounds on the memory that reading a log file takes: no more than the file holds, or than its chunks may unpack to.

A damaged length, or a file made to do harm, may claim any size, and the MCAP library believes it.
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
"""Records of one chunk, each of which becomes an object: roughmap writes some thousands, other tools ten times that."""

RECORD_HEAD = struct.Struct("<BQ")
"""First bytes of a record: its opcode and the number of bytes that follow."""


class BoundedFile:
    """A file whose `read` asks for no more than the file holds: a read allocates as much as it asks for."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = os.fstat(stream.fileno()).st_size - stream.tell()

    def read(self, size: int) -> bytes:
        """Return at most ``size`` bytes; ValueError below 0, for which a file would return everything."""
        if size < 0:
            raise ValueError("a record shorter than its fixed fields")
        data = self._stream.read(min(size, self._left))
        self._left -= len(data)
        return data


def records_in(chunk: Chunk, most: int) -> Iterator[McapRecord]:
    """Yield a chunk's records after verifying its checksum.

    ValueError, or what the libraries raise, if it is damaged or unpacks to more than ``most`` bytes.
    """
    size = chunk.uncompressed_size
    if size > most:
        raise ValueError(f"a chunk of {size} bytes (at most {most})")
    data = _unpack(chunk)
    if len(data) != size:
        raise ValueError(f"a chunk of {size} bytes has {len(data)}")
    at = number = 0
    while at < size:
        number += 1
        head = at + RECORD_HEAD.size
        at = head + RECORD_HEAD.unpack_from(data, at)[1] if head <= size else head
        if number > MAX_RECORDS or at > size:
            raise ValueError(f"a chunk with more than {MAX_RECORDS} records or an incomplete last one")
    yield from breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)


def _unpack(chunk: Chunk) -> bytes:
    """Return the chunk's data, never more than the size it claims."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (-1, size):  # -1: the frame does not say
            raise ValueError(f"a chunk of {size} bytes unpacks to another size")
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        return data
    if chunk.compression:
        raise ValueError(f"a chunk with unknown compression {chunk.compression[:20]!r}")
    return bytes(chunk.data)
