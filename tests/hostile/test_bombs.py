"""Small bytes that unpack to, or claim to be, very many: refused before they are in memory."""

import struct
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Header, Metadata

from roughmap_schemas import Config, MessageFault, RunMetadata, decode_cloud, decode_grid
from roughmap_schemas.grid import DATA_TAG, encode_grid
from roughmap_schemas.wire import write_varint
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.recorded import CloudFileFault
from roughmap_service.journal.reader import MAGIC, DamagedLog, LogError, TornLog, raw_records
from roughmap_service.journal.repair import repair
from roughmap_service.store.map_db import DamagedStore, Store

MIB = 1 << 20
BOMB = 256 * MIB
"""Bytes of zeros that each bomb unpacks to; 10 to 30 KB packed by zstd, 1 MB by lz4."""

MOST = 32 * MIB
"""What may be allocated over one: far below what it unpacks to, and above its own bytes and the reader's buffers."""


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MOST, f"{peak / MIB:.0f} MiB"


@pytest.fixture(scope="module")
def packed() -> dict[str, bytes]:
    """The bomb by each compression; each tells its size."""
    zeros = bytes(MIB)
    zstd = zstandard.ZstdCompressor().compressobj(size=BOMB)
    lz = lz4.frame.LZ4FrameCompressor()
    blocks = BOMB // MIB
    return {
        "zstd": b"".join(zstd.compress(zeros) for _ in range(blocks)) + zstd.flush(),
        "lz4": lz.begin(BOMB) + b"".join(lz.compress(zeros) for _ in range(blocks)) + lz.flush(),
    }


def log_file(path: Path, data: bytes, size: int, compression: str, **settings: object) -> Path:
    """A log whose only chunk has this data, and says that it unpacks to ``size`` bytes."""
    configuration = Config.model_validate({"input": settings}).public_dict()
    entries = RunMetadata(
        run="0" * 32, created_ns=0, epoch=1, index=0, first_input=1, first_record=1, base_sequence=0, base_digest="",
        version="0", configuration=configuration,
    ).to_record()  # fmt: skip
    builder = RecordBuilder()
    Header(profile="roughmap", library="").write(builder)
    Metadata(name="roughmap", metadata=entries).write(builder)
    Chunk(
        compression=compression, data=data, message_start_time=0, message_end_time=0, uncompressed_crc=0,
        uncompressed_size=size,
    ).write(builder)  # fmt: skip
    path.write_bytes(MAGIC + builder.end())
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("told", [1000, BOMB], ids=["its size hidden", "its size told"])
def test_chunks_of_a_log(tmp_path: Path, packed: dict[str, bytes], compression: str, told: int) -> None:
    """Read, and rewritten by a repair: what stands before it is kept."""
    path = log_file(tmp_path / "a.mcap", packed[compression], told, compression)
    with little_memory():
        with pytest.raises(DamagedLog, match="a chunk of"):
            list(raw_records(path))
        assert repair(path) == tmp_path / "a.mcap.torn"
        assert len(list(raw_records(path))) == 2, "header and metadata"


def test_a_chunk_of_a_million_records(tmp_path: Path) -> None:
    """Each would become an object; nine bytes are enough for one of an unknown kind."""
    data = struct.pack("<BQ", 0x80, 0) * 1_000_000
    path = log_file(tmp_path / "a.mcap", zstandard.compress(data), len(data), "zstd")
    with little_memory(), pytest.raises(DamagedLog, match="records"):
        list(raw_records(path))


@pytest.mark.parametrize("kind", [0x02, 0x06, 0x0C, 0x80], ids=["footer", "chunk", "metadata", "unknown"])
@pytest.mark.parametrize("length", [1 << 29, 1 << 62])
def test_records_of_any_length(tmp_path: Path, kind: int, length: int) -> None:
    path = log_file(tmp_path / "a.mcap", b"", 0, "")
    with path.open("ab") as stream:
        stream.write(struct.pack("<BQ", kind, length) + b"\xff" * 40)
    with little_memory(), pytest.raises(LogError):
        list(raw_records(path))


def test_as_large_a_message_as_the_log_was_configured_for(tmp_path: Path, packed: dict[str, bytes]) -> None:
    """What is one's own is read, whatever its size."""
    data = struct.pack("<BQ", 0x80, 100 * MIB) + bytes(100 * MIB)
    for most, told in ((200 * MIB, True), (64 * MIB, False)):
        settings = {"max_message": most, "queue_limit": most}
        path = log_file(tmp_path / "a.mcap", zstandard.compress(data), len(data), "zstd", **settings)
        with pytest.raises(TornLog if told else DamagedLog):
            list(raw_records(path))


def test_a_reply_to_the_client(packed: dict[str, bytes]) -> None:
    grid = encode_grid({"mean_height": np.zeros((2, 2))}, (0, 0), 0.1, 0, "map")
    for frame in (packed["zstd"], packed["zstd"][:100]):
        payload = grid + DATA_TAG + write_varint(len(frame)) + frame  # of a field that stands twice the last one holds
        with little_memory(), pytest.raises(MessageFault, match="too_large"):
            decode_grid(payload, "zstd", max_data=16 * MIB)


def test_a_tile_of_the_store(packed: dict[str, bytes]) -> None:
    with little_memory(), pytest.raises(DamagedStore, match=r"tile \(0, 0\) is damaged"):
        Store(Path("map.db")).unpack(0, 0, bytes(16), packed["zstd"])


def test_an_archive_of_points(tmp_path: Path) -> None:
    """Of a size that no machine has, in its directory or in the array's own header."""
    path = tmp_path / "cloud.npz"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d, 3)}" % (1 << 50)
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("points", "a", "b", "c", "d"):
            archive.writestr(f"{name}.npy", array)
    with pytest.raises(CloudFileFault):  # numpy asks for memory that nobody has, and is refused it
        list(read_cloud(path))
    raw = bytearray(path.read_bytes())
    at = -1
    while (at := raw.find(b"PK\x01\x02", at + 1)) >= 0:  # an entry of the directory; its size unpacked is 24 bytes on
        raw[at + 24 : at + 28] = b"\xfe\xff\xff\xff"
    path.write_bytes(raw)
    with little_memory(), pytest.raises(CloudFileFault, match="split it"):
        list(read_cloud(path))


@pytest.mark.parametrize("number", [7, 2**31, 2**63], ids=["a gap", "2 GiB", "8 EiB"])
def test_a_cloud_that_claims_more_than_it_has(number: int) -> None:
    payload = b"\x2a" + write_varint(number) + b"abc"
    with little_memory(), pytest.raises(MessageFault, match="bad_message"):
        decode_cloud(payload, max_message=MIB, max_points=100)
