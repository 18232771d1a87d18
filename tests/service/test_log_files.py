"""A log as others read it: the stock reader, schemas that decode without us, numbers and times, files in a row."""

import json
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from mcap.reader import make_reader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from service_tools import (
    GROUND,
    SECOND,
    T0,
    WAIT_S,
    Run,
    cloud,
    config,
    events_of,
    inputs_of,
    metadata,
    odometry,
    read_back,
    starts_of,
    transform,
)

from roughmap_schemas import RunMetadata, encode_event
from roughmap_service.log_file import COMPRESSIONS, Kind, LogRecord
from roughmap_service.log_writer import LogWriter, Rotate


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file of a run with each kind of input, events and a query."""
    directory = tmp_path_factory.mktemp("log")
    with Run(directory) as run:
        run.put(Kind.TRANSFORM, transform(0.0))
        run.put(Kind.ODOMETRY, odometry(0.0, frame="odom"))
        run.put(Kind.POINTS, cloud(0.05))
        run.put(Kind.ODOMETRY, odometry(0.1))
        run.decide()
        run.checkpoint()
        run.writer.put_output(LogRecord(Kind.QUERIES, run.keys.queries, b'{"selector":"x"}', T0, T0))
        run.writer.put_output(LogRecord(Kind.UPDATES, run.keys.updates_topic, b'{"key":"x"}', T0, T0))
    return directory


def messages(directory: Path) -> list[tuple[Schema, Channel, Message]]:
    """All messages as the stock reader gives them."""
    (path,) = directory.glob("*.mcap")
    with path.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages())  # type: ignore[arg-type]


def test_the_stock_reader_knows_all_of_it(logged: Path) -> None:
    (path,) = logged.glob("*.mcap")
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 8
        assert summary.statistics.metadata_count == 1
        assert {channel.topic for channel in summary.channels.values()} == {
            "robots/rover/points", "robots/rover/odometry", "robots/rover/transform", "maps/site/events",
            "maps/site/queries", "maps/site/updates",
        }  # fmt: skip
        assert {(s.name, s.encoding) for s in summary.schemas.values()} == {
            ("foxglove.PointCloud", "protobuf"), ("foxglove.Odometry", "protobuf"),
            ("foxglove.FrameTransform", "protobuf"), ("roughmap.Event", "jsonschema"),
            ("roughmap.QueryRecord", "jsonschema"), ("roughmap.UpdateRecord", "jsonschema"),
        }  # fmt: skip
        (record,) = reader.iter_metadata()
        assert RunMetadata.from_record(record.metadata).first_input == 1


def test_the_metadata_stands_before_all_messages(logged: Path) -> None:
    (path,) = logged.glob("*.mcap")
    with path.open("rb") as stream:
        kinds = [type(record) for record in StreamReader(stream).records]
    assert kinds.index(Metadata) < kinds.index(Message)


def test_protobuf_channels_decode_by_their_own_schema(logged: Path) -> None:
    """With google.protobuf and what the file holds, and nothing else."""
    found: dict[str, Any] = {}
    for schema, channel, message in messages(logged):
        if channel.message_encoding == "protobuf":
            files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
            kind = message_factory.GetMessages(files.file, pool=descriptor_pool.DescriptorPool())[schema.name]
            found[schema.name] = json_format.MessageToDict(kind.FromString(message.data))
    assert found["foxglove.PointCloud"]["frameId"] == "lidar"
    assert len(found["foxglove.PointCloud"]["fields"]) == 3
    assert len(found["foxglove.Odometry"]["poseCovariance"]) == 36
    assert found["foxglove.FrameTransform"]["childFrameId"] == "odom"


def test_events_fit_the_schema_of_their_channel(logged: Path) -> None:
    kinds = []
    for schema, channel, message in messages(logged):
        if channel.topic == "maps/site/events":
            value, told = json.loads(message.data), json.loads(schema.data)
            assert (told["title"], told["type"]) == (schema.name, "object")
            for name in value.keys() & told["properties"].keys():
                assert isinstance(value[name], {"integer": int, "string": str}[told["properties"][name]["type"]])
            kinds.append(value["kind"])
    assert kinds == ["integration", "checkpoint"]


def test_messages_are_the_exact_bytes_with_their_stamps_and_numbers(logged: Path) -> None:
    inputs = [
        (channel.topic.rpartition("/")[2], m.data, m.publish_time, m.sequence)
        for _, channel, m in messages(logged)
        if channel.message_encoding == "protobuf"
    ]
    assert inputs == [
        ("transform", transform(0.0), T0, 1),
        ("odometry", odometry(0.0, frame="odom"), T0, 2),
        ("points", cloud(0.05), T0 + SECOND // 20, 3),
        ("odometry", odometry(0.1), T0 + SECOND // 10, 4),
    ]


def point(number: int, received: int, stamp: int = T0) -> LogRecord:
    return LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(0.0), received, stamp, number)


def test_log_times_rise_however_the_clock_goes(tmp_path: Path) -> None:
    """Also from file to file, so that a reader that merges files keeps the run's order."""
    with LogWriter(tmp_path, metadata()) as writer:
        for number, received in enumerate([100, 100, 50, 200, 7], 1):
            writer.put(point(number, received))
        writer.put(Rotate("0" * 32))
        writer.put(point(6, 10))
    assert [item.received_ns for item in inputs_of(read_back(tmp_path))] == [100, 101, 102, 200, 201, 202]


def test_numbers_go_on_over_files(tmp_path: Path) -> None:
    with Run(tmp_path) as run:
        run.scan(0.0)
        run.rotate()
        run.rotate()
        run.scan(1.0)
    items = read_back(tmp_path)
    starts = [start.metadata for start in starts_of(items)]
    assert [(m.index, m.first_input, m.first_record, m.base_sequence, m.epoch) for m in starts] == [
        (0, 1, 1, 0, 1), (1, 4, 6, 1, 1), (2, 4, 7, 1, 1),
    ]  # fmt: skip
    assert starts[1].base_digest == starts[2].base_digest != starts[0].base_digest
    assert [item.number for item in inputs_of(items)] == [1, 2, 3, 4, 5, 6]
    assert [item.record for item in items if hasattr(item, "record")] == list(range(1, 11))
    assert events_of(items)[-1].sequence == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"roughmap-{run.run}-{n:06d}.mcap" for n in range(3)]


@pytest.mark.parametrize("limit", ["bytes", "age"])
def test_a_file_wants_an_end_at_its_size_or_age_once(tmp_path: Path, limit: str) -> None:
    limits: dict[str, Any] = {"max_file_bytes": 20_000} if limit == "bytes" else {"max_file_age": 0.0}
    with LogWriter(tmp_path, metadata(), **limits) as writer:
        number = 0
        while not writer.wants_rotation():
            assert number < 1000
            number += 1
            writer.put(point(number, number))
            assert writer.wait_synced(WAIT_S)
        writer.put(Rotate("0" * 32))
        if limit == "bytes":  # a file of age 0 wants its end again as soon as it was begun
            assert not writer.wants_rotation(), "it was asked for"
            assert writer.wait_synced(WAIT_S)
            assert not writer.wants_rotation(), "the new file is small"
        sizes = [path.stat().st_size for path in sorted(tmp_path.iterdir())]
    assert len(starts_of(read_back(tmp_path))) == 2
    if limit == "bytes":
        assert 20_000 <= sizes[0] < 40_000


@pytest.mark.parametrize("compression", sorted(COMPRESSIONS))
def test_compressed_or_not_it_reads_the_same(tmp_path: Path, compression: str) -> None:
    payloads = [cloud(0.1 * n, points=GROUND.repeat(500, axis=0)) for n in range(5)]
    with LogWriter(tmp_path, metadata(), compression=compression) as writer:
        for number, payload in enumerate(payloads, 1):
            writer.put(LogRecord(Kind.POINTS, "robots/rover/points", payload, number, T0, number))
    assert [item.payload for item in inputs_of(read_back(tmp_path))] == payloads
    (path,) = tmp_path.iterdir()
    with path.open("rb") as stream:
        assert [m.data for _, _, m in make_reader(stream, validate_crcs=True).iter_messages()] == payloads


def test_keys_of_the_configuration_name_the_channels(tmp_path: Path) -> None:
    """The same keys tell the reader what a channel holds; a channel of another key is none of the run."""
    with Run(tmp_path, config(keys={"odometry": "fleet/{robot}/pose"})) as run:
        event = run.scan(0.0)
        run.writer.put(LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(5.0), T0, T0))
        run.writer.put(LogRecord(Kind.EVENTS, "maps/other/events", encode_event(event), T0, T0))
    items = read_back(tmp_path)
    assert [(item.kind, item.robot) for item in inputs_of(items)] == [
        (Kind.ODOMETRY, "rover"), (Kind.POINTS, "rover"), (Kind.ODOMETRY, "rover"),
    ]  # fmt: skip
    assert events_of(items) == [event]
