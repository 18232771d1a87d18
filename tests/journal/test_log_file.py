"""What a log file holds, read by the stock MCAP reader and what stands in the file alone."""

import contextlib
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from service_tools import GROUND, T0, WAIT_S, LoggedRun, cloud, config, metadata, odometry, transform

from roughmap_schemas import RunMetadata, encode_cloud
from roughmap_schemas.kinds import Kind
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.file import LogFile
from roughmap_service.journal.items import Rotate, Sync
from roughmap_service.journal.reader import read_metadata
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.run_files import find_files
from roughmap_service.journal.writer import LogWriter


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A closed file with all that a run has."""
    with LoggedRun(tmp_path) as run:
        run.put(Kind.TRANSFORM, transform(0.0))
        run.scan(0.0)
        run.checkpoint()
        run.scan(1.0, robot="other")
        run.reset()
        run.checkpoint()
    (path,) = tmp_path.glob("*.mcap")
    return path


def messages(path: Path) -> list[tuple[Any, Any, Message]]:
    """Schema, channel and message in file order, by the stock reader over the file's index."""
    with path.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False))


def test_the_stock_reader_finds_all(file: Path) -> None:
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "roughmap"
        summary = reader.get_summary()
        (record,) = reader.iter_metadata()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages(file)) == 12
    assert {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()} == {
        "robots/rover/points": "foxglove.PointCloud",
        "robots/rover/odometry": "foxglove.Odometry",
        "robots/rover/transform": "foxglove.FrameTransform",
        "robots/other/points": "foxglove.PointCloud",
        "robots/other/odometry": "foxglove.Odometry",
        "maps/site/events": "roughmap.Event",
    }
    assert record.name == RECORD_NAME
    found = RunMetadata.from_record(record.metadata)
    assert (found.index, found.first_input, found.first_record, found.base_sequence) == (0, 1, 1, 0)
    assert found.configuration == config().public_dict()


def test_the_metadata_stands_before_all_else(file: Path) -> None:
    with file.open("rb") as stream:
        kinds = [type(record).__name__ for record in StreamReader(stream, emit_chunks=True).records]
    assert kinds[:2] == ["Header", "Metadata"]
    assert read_metadata(file).index == 0


def test_protobuf_messages_are_read_by_what_the_file_says_of_them(file: Path) -> None:
    """With google.protobuf alone: the embedded descriptors are complete, imports first."""
    seen = set()
    for schema, channel, message in messages(file):
        if schema.encoding != "protobuf":
            continue
        assert channel.message_encoding == "protobuf"
        pool = DescriptorPool()
        for one in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(one)
        decoded: Any = GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(message.data)
        assert decoded.timestamp.ToNanoseconds() == message.publish_time
        seen.add(schema.name)
        if schema.name == "foxglove.PointCloud":
            assert [field.name for field in decoded.fields][:3] == ["x", "y", "z"]
    assert seen == {"foxglove.PointCloud", "foxglove.Odometry", "foxglove.FrameTransform"}


JSON_TYPES = {"integer": int, "string": str, "number": float, "boolean": bool, "array": list, "object": dict}


def test_events_are_what_the_embedded_schema_says(file: Path) -> None:
    kinds = []
    for schema, channel, message in messages(file):
        if schema.name == "roughmap.Event":
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            event = json.loads(message.data)
            embedded = json.loads(schema.data)
            assert (embedded["title"], embedded["type"]) == ("roughmap.Event", "object")
            told = {name: JSON_TYPES[value["type"]] for name, value in embedded["properties"].items() if name in event}
            assert told.keys() >= {"kind", "epoch", "sequence"}
            assert all(type(event[name]) is kind for name, kind in told.items())
            kinds.append(event["kind"])
    assert kinds == ["integration", "checkpoint", "integration", "reset", "checkpoint"]


def test_inputs_are_their_exact_bytes_and_numbered(tmp_path: Path) -> None:
    payloads = [odometry(0.0), cloud(0.05), odometry(0.1), transform(0.1)]
    with LoggedRun(tmp_path) as run:
        for kind, payload in zip((Kind.ODOMETRY, Kind.POINTS, Kind.ODOMETRY, Kind.TRANSFORM), payloads, strict=True):
            run.put(kind, payload)
    (path,) = tmp_path.glob("*.mcap")
    found = messages(path)
    assert [message.data for _, _, message in found] == payloads
    assert [message.sequence for _, _, message in found] == [1, 2, 3, 4]
    assert [message.publish_time - T0 for _, _, message in found] == [0, 50_000_000, 100_000_000, 100_000_000]


def test_log_time_is_the_receive_time_made_to_rise(tmp_path: Path) -> None:
    """A clock that stands still or goes back changes neither the order nor makes two times equal."""
    received = [T0, T0, T0 - 10**9, T0 + 5, T0 + 5, T0 + 10**9]
    with LogWriter(tmp_path, metadata()) as writer:
        for number, at in enumerate(received, 1):
            writer.put(LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(0.0), at, T0, number))
    (path,) = tmp_path.glob("*.mcap")
    found = [message.log_time - T0 for _, _, message in messages(path)]
    assert found == [0, 1, 2, 5, 6, 10**9]


def test_times_rise_over_files(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as run:
        for k in range(3):
            run.scan(float(k))
            run.rotate()
    times = [message.log_time for file in find_files([tmp_path]) for _, _, message in messages(file.path)]
    assert all(before < after for before, after in pairwise(times))
    starts = [file.metadata for file in find_files([tmp_path])]
    assert [(start.index, start.first_input, start.first_record, start.base_sequence) for start in starts] == [
        (0, 1, 1, 0),
        (1, 4, 6, 1),
        (2, 7, 11, 2),
        (3, 10, 16, 3),
    ]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_compressions(compression: str, tmp_path: Path) -> None:
    """A scan is larger than a chunk; nothing of it is lost, and squeezed it is smaller."""
    payload = encode_cloud(GROUND.repeat(20_000, axis=0), T0, "lidar")
    path = tmp_path / "a.mcap"
    file = LogFile(path, metadata(), compression)
    for number in (1, 2):
        file.write(LogRecord(Kind.POINTS, "robots/rover/points", payload, T0, T0, number))
    file.close()
    assert [message.data for _, _, message in messages(path)] == [payload, payload]
    assert (path.stat().st_size < len(payload)) == (compression != "none")


def test_a_file_is_never_written_over(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"there")
    with pytest.raises(FileExistsError):
        LogFile(path, metadata(), "none")
    assert path.read_bytes() == b"there"


def test_what_was_synced_is_on_the_disk_and_whole(tmp_path: Path) -> None:
    """Without the footer, as after a kill: the stock reader gives all that was synced, then says that it's torn."""
    with LoggedRun(tmp_path / "log") as run:
        run.scan(0.0)
        left = run.killed(tmp_path / "left")
    (path,) = left.glob("*.mcap")
    assert read_torn(path) == ["Header", "Metadata", *["Message"] * 4]


def read_torn(path: Path) -> list[str]:
    """What the stock reader gives of a torn file, without schemas and channels."""
    kinds: list[str] = []
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream).records:
            kinds += [type(record).__name__]
        raise AssertionError("the file is not torn")
    return [kind for kind in kinds if kind in ("Header", "Metadata", "Message")]


def test_one_failing_callback_keeps_no_other_from_being_called(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is neither taken for a fault of the disk: the file goes on."""

    def fail() -> None:
        raise RuntimeError("the asker's own fault")

    called: list[int] = []
    with LoggedRun(tmp_path) as run:
        run.writer.put(Sync(fail))
        run.writer.put(Sync(lambda: called.append(1)))
        run.writer.put(Sync(fail))
        run.writer.put(Sync(lambda: called.append(2)))
        assert run.writer.wait_synced(WAIT_S)
        assert run.writer.ok
        run.scan(0.0)
    assert called == [1, 2]
    assert len(list(tmp_path.glob("*.mcap"))) == 1
    assert "the asker's own fault" in caplog.text


def test_a_rotation_is_wanted_once_and_again_after_it(tmp_path: Path) -> None:
    with LogWriter(tmp_path, metadata(), max_file_bytes=1) as writer:
        for index in range(1, 4):
            assert writer.wants_rotation()
            writer.put(Rotate(""))
            assert writer.wait_synced(WAIT_S)
            assert writer.index == index
    with LogWriter(tmp_path, metadata(index=8), max_file_age=0.0) as writer:
        assert writer.wants_rotation()
    with LogWriter(tmp_path, metadata(index=9)) as writer:
        assert not writer.wants_rotation()
