"""Bounded decompression for rosbags, whose own unpacks whatever comes: a few kilobytes can stand for gigabytes."""

import bz2
from typing import Final

import lz4.frame
import zstandard
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap

MAX_CHUNK: Final = 1 << 30
"""Most bytes of a chunk, unpacked: one is in memory at a time, and those that overlap it."""


def unpack_zstd(data: bytes, size: int | None = None) -> bytes:
    """Unpack to at most one byte more than ``size``, or than `MAX_CHUNK`: that shows that it is too much."""
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return bytes(stream.read(_most(size)))


def unpack_lz4(data: bytes, size: int | None = None) -> bytes:
    """As `unpack_zstd`."""
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=_most(size)))


def unpack_bz2(data: bytes, size: int | None = None) -> bytes:
    """As `unpack_zstd`."""
    return bz2.BZ2Decompressor().decompress(data, _most(size))


def _most(size: int | None) -> int:
    return (MAX_CHUNK if size is None else min(size, MAX_CHUNK)) + 1


def bound_rosbags() -> None:
    """Make rosbags unpack no more than a chunk says that it holds, and no chunk of more than `MAX_CHUNK`."""
    storage_mcap.DECOMPRESSORS.update(zstd=unpack_zstd, lz4=unpack_lz4)
    for kind, unpack in (("bz2", unpack_bz2), ("lz4", unpack_lz4)):
        rosbag1.decompressors[kind] = unpack
