"""The writer of log files, beside the mcap library's: the same bytes, whatever is written."""

import io
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from properties import examples

from roughmap_service.journal.checksums import combined
from roughmap_service.journal.mcap_writer import LARGE_BYTES, McapWriter

CHUNK = 1 << 16
SIZES = st.integers(0, 300) | st.sampled_from(
    [LARGE_BYTES - 1, LARGE_BYTES, CHUNK - 31, CHUNK - 30, CHUNK, CHUNK + 1, 200_000]
)
MESSAGES = st.tuples(st.just("message"), st.integers(1, 3), SIZES, st.integers(0, 2**63), st.integers(0, 2**32 - 1))
STEPS = st.lists(MESSAGES | st.just(("flush",)) | st.tuples(st.just("metadata"), st.text(max_size=5)), max_size=12)


def payload(size: int, seed: int) -> bytes:
    return (seed.to_bytes(8, "little") * (size // 8 + 1))[:size]


@examples(60)
@given(STEPS, st.sampled_from(["none", "lz4", "zstd"]), st.integers(1, 2**62))
def test_the_same_bytes(steps: list[tuple], compression: str, time: int) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    mine = McapWriter(ours, chunk_bytes=CHUNK, compression=compression)
    kind = CompressionType[compression.upper()]
    library = Writer(theirs, chunk_size=CHUNK, compression=kind, enable_data_crcs=True)
    mine.start("profile")
    library.start(profile="profile")
    channels: dict[int, int] = {}
    for step in steps:
        if step[0] == "flush":
            mine.flush()
            library.flush()
        elif step[0] == "metadata":
            mine.add_metadata("one", {"key": step[1]})
            library.add_metadata("one", {"key": step[1]})
        else:
            _, channel, size, publish_time, sequence = step
            if channel not in channels:
                schema = mine.register_schema(f"s{channel}", "jsonschema", b"{}")
                assert schema == library.register_schema(f"s{channel}", "jsonschema", b"{}")
                channels[channel] = mine.register_channel(f"topic/{channel}", "json", schema)
                assert channels[channel] == library.register_channel(f"topic/{channel}", "json", schema)
            time += 1
            data = payload(size, time)
            mine.add_message(channels[channel], time, data, publish_time, sequence)
            library.add_message(channels[channel], time, data, publish_time, sequence)
        assert ours.getvalue() == theirs.getvalue()
    mine.finish()
    library.finish()
    assert ours.getvalue() == theirs.getvalue()


@given(st.binary(max_size=200), st.binary(max_size=200), st.integers(1, 500))
def test_checksums_of_two_strings(first: bytes, second: bytes, times: int) -> None:
    second *= times
    assert combined(zlib.crc32(first), zlib.crc32(second), len(second)) == zlib.crc32(first + second)


@pytest.mark.parametrize("length", [0, 1, 2**16, 2**21 + 12345, 2**26 + 1])
def test_checksums_of_long_strings(length: int) -> None:
    second = bytes(length)
    assert combined(zlib.crc32(b"first"), zlib.crc32(second), length) == zlib.crc32(second, zlib.crc32(b"first"))
