"""What rosbags unpacks is bounded: by what a chunk says that it holds, and by the most that a chunk may hold."""

import bz2
from collections.abc import Callable

import lz4.frame
import pytest
import zstandard
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.storage_mcap import decompress

from roughmap_service.formats import unpacking
from roughmap_service.formats.bag_files import open_bag  # noqa: F401 - which bounds rosbags

DATA = bytes(range(256)) * 1000
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "bz2": bz2.compress,
}


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_chunk_is_unpacked_to_what_it_says(kind: str) -> None:
    assert decompress(PACK[kind](DATA), kind, len(DATA), 0) == DATA
    with pytest.raises(ReaderError, match="expected 100 bytes, got 101"):
        decompress(PACK[kind](bytes(1 << 28)), kind, 100, 0)


@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_a_chunk_of_ros_1_is_unpacked_up_to_a_limit(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rosbag1.decompressors[kind](PACK[kind](DATA)) == DATA
    monkeypatch.setattr(unpacking, "MAX_CHUNK", 1000)
    assert rosbag1.decompressors[kind](PACK[kind](DATA)) == DATA[:1001]


def test_two_frames_of_zstd_are_one_chunk() -> None:
    packed = zstandard.compress(DATA) + zstandard.compress(b"more")
    assert decompress(packed, "zstd", len(DATA) + 4, 0) == DATA + b"more"
