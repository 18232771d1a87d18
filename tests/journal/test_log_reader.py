"""Reading the log back: what is the run's, in which order, and what is refused in one line that names the file."""

import struct
from pathlib import Path

import pytest
from log_edits import nth, rewrite
from mcap.writer import CompressionType, Writer
from service_tools import T0, LoggedRun, cloud, config, events_of, inputs_of, metadata, odometry, read_back, starts_of

from roughmap_schemas import Config, encode_event
from roughmap_schemas.kinds import Kind
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.file import LogFile
from roughmap_service.journal.reader import LogError, read_file
from roughmap_service.journal.records import LogItem, LogRecord
from roughmap_service.journal.run_files import RunFile, find_files, one_run, read_run


def scans(run: LoggedRun, count: int = 2) -> None:
    for k in range(count):
        run.scan(float(k), 0.3 * k)
        run.checkpoint()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A closed file of a run."""
    with LoggedRun(tmp_path / "log") as run:
        scans(run)
    (path,) = (tmp_path / "log").glob("*.mcap")
    return path


def one_line(path: Path, words: str) -> None:
    """The file is refused with one line that names it."""
    with pytest.raises(LogError) as caught:
        list(read_file(path))
    told = str(caught.value)
    assert str(path) in told
    assert words in told
    assert "\n" not in told


def test_all_in_file_order_with_their_numbers(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as run:
        scans(run)
        run.rotate()
        run.scan(2.0)
        run.checkpoint()
        expected = run.run.input, run.run.record
    items = read_back(tmp_path)
    inputs, events = inputs_of(items), [item for item in items if not hasattr(item, "path")]
    assert [item.number for item in inputs] == list(range(1, expected[0] + 1))
    assert [item.record for item in events] == list(range(1, expected[1] + 1))
    assert [item.kind for item in inputs[:3]] == [Kind.ODOMETRY, Kind.POINTS, Kind.ODOMETRY]
    assert {item.robot for item in inputs} == {"rover"}
    assert (inputs[1].payload, inputs[1].stamp_ns) == (cloud(0.03), T0 + 30_000_000)
    assert [start.metadata.index for start in starts_of(items)] == [0, 1]
    assert [event.kind for event in events_of(items)] == ["integration", "checkpoint"] * 2 + ["checkpoint"] + [
        "integration",
        "checkpoint",
    ]


def test_outputs_and_foreign_channels_are_passed_over(tmp_path: Path) -> None:
    """They have no number and no place in the run."""
    path = tmp_path / "a.mcap"
    file = LogFile(path, metadata(), "none")
    file.write(LogRecord(Kind.UPDATES, "maps/site/updates", b"{}", T0, T0))
    file.write(LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(0.0), T0, T0, 1))
    file.write(LogRecord(Kind.QUERIES, "maps/site/queries", b"{}", T0, T0))
    file.write(LogRecord(Kind.EVENTS, "maps/elsewhere/events", b"not ours", T0, T0))
    file.write(LogRecord(Kind.ODOMETRY, "camera/odometry", b"not ours", T0, T0))
    file.write(LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(1.0), T0, T0, 2))
    file.close()
    assert [(item.number, item.record) for item in inputs_of(read_file(path))] == [(1, 1), (2, 2)]
    assert len(list(read_file(path))) == 3


def test_keys_are_those_of_the_files_own_configuration(tmp_path: Path) -> None:
    keys = {"points": "fleet/{robot}/lidar", "events": "{map}/log"}
    settings = Config.model_validate({**config(map={"name": "hall"}).public_dict(), "keys": keys})
    path = tmp_path / "a.mcap"
    file = LogFile(path, metadata(configuration=settings.public_dict()), "none")
    file.write(LogRecord(Kind.POINTS, "fleet/a1/lidar", cloud(0.0), T0, T0, 1))
    file.write(LogRecord(Kind.POINTS, "robots/a1/points", cloud(1.0), T0, T0, 2))
    file.write(LogRecord(Kind.EVENTS, "hall/log", b'{"kind":"reset","epoch":2,"sequence":1}', T0, T0))
    file.close()
    items = list(read_file(path))
    assert [(item.robot, item.payload) for item in inputs_of(items)] == [("a1", cloud(0.0))]
    assert [encode_event(event) for event in events_of(items)] == [b'{"kind":"reset","epoch":2,"sequence":1}']


def test_what_is_no_log(tmp_path: Path, file: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("this is no MCAP file, though it is called one\n" * 10)
    one_line(text, "not an MCAP file")
    text.write_text("short")
    one_line(text, "not an MCAP file")
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("other", {"a": "b"})
        channel = writer.register_channel("topic", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    one_line(foreign, "not a log of roughmap")
    empty = tmp_path / "empty.mcap"
    empty.touch()
    one_line(empty, "ends before its footer")
    rewrite(file, configuration={"map": {"cell_size": -1}})
    one_line(file, "its configuration can't be read")
    with pytest.raises(LogError, match=r"nowhere\.mcap: No such file"):
        find_files([tmp_path / "nowhere.mcap"])
    with pytest.raises(LogError, match="no log files"):
        one_run(find_files([]))


def test_metadata_of_another_make(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(RECORD_NAME, {"run": "not hex"})
        writer.finish()
    one_line(path, "metadata record roughmap")


def test_an_event_that_cant_be_read(file: Path) -> None:
    for data in (b'{"kind":"edit","epoch":1,"sequence":3}', b"{", b"\xff\x00", b""):
        rewrite(file, nth("/events", 1, lambda _, data=data: data))
        one_line(file, "event at record 5")


def test_a_flipped_byte_anywhere_is_reported_or_changes_nothing(file: Path) -> None:
    """Chunks have checksums; of the rest, the file's beginning must be readable, and lengths must fit.

    Where the flip lies in the text of the metadata the file is another one, and its messages are the same.
    """
    whole = file.read_bytes()
    expected = messages_of(file)
    told = 0
    for at in [*range(200), *range(200, len(whole), 41)]:
        data = bytearray(whole)
        data[at] ^= 0x55
        file.write_bytes(data)
        found = messages_of(file)
        assert found == expected or found == [str(file)], at
        told += found != expected
    assert told > 100


def messages_of(path: Path) -> list[object]:
    """What a file says beside its numbers, which come from its beginning; or the file that a one-line error names."""
    try:
        items: list[LogItem] = list(read_file(path))
    except LogError as error:
        told = str(error)
        return [name for name in (str(path),) if name in told and "\n" not in told]
    inputs = [(item.kind, item.robot, item.payload, item.received_ns, item.stamp_ns) for item in inputs_of(items)]
    return [*inputs, *((event,) for event in events_of(items))]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_damaged_length_is_no_allocation(compression: CompressionType, tmp_path: Path) -> None:
    """A chunk that claims to unpack to 2^62 bytes, and a record that claims to be so long."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start()
        writer.add_metadata(RECORD_NAME, metadata().to_record())
        channel = writer.register_channel("robots/rover/odometry", "protobuf", 0)
        for number in range(20):
            writer.add_message(channel, number, bytes(500), number)
        writer.finish()
    data = bytearray(path.read_bytes())
    name = compression.name.lower().encode()
    field = data.index(struct.pack("<I", len(name)) + name) - 12  # before the CRC, the unpacked size
    data[field : field + 8] = struct.pack("<Q", 1 << 62)
    path.write_bytes(data)
    one_line(path, f"a chunk of {1 << 62} bytes")
    chunk = field - 16 - 9  # the chunk's opcode: before its times and its own length
    assert data[chunk] == 6
    data[chunk + 1 : chunk + 9] = struct.pack("<Q", 1 << 62)
    path.write_bytes(data)
    one_line(path, str(1 << 62))


def test_files_are_ordered_by_run_and_index_and_each_is_there_once(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log") as run:
        for k in range(3):
            run.scan(float(k))
            run.rotate()
    files = find_files([tmp_path / "log"])
    renamed = [file.path.rename(tmp_path / "log" / f"{name}.mcap") for file, name in zip(files, "dbca", strict=True)]
    assert [file.metadata.index for file in find_files([renamed[2], tmp_path / "log", renamed[0]])] == [0, 1, 2, 3]
    (tmp_path / "log" / "a.mcap.torn").write_bytes(b"a torn rest is no file of the run")
    assert len(find_files([tmp_path / "log"])) == 4


def test_gaps_are_named(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as run:
        for k in range(3):
            run.scan(float(k))
            run.rotate()
    files = find_files([tmp_path])
    with pytest.raises(
        LogError, match=f"gap: file 1 .* between {files[0].path.name} and {files[2].path.name}: put it back"
    ):
        one_run([files[0], *files[2:]])
    with pytest.raises(LogError, match="are both file 1"):
        one_run([*files[:2], *files[1:]])
    other = RunFile(files[1].path, files[1].metadata.model_copy(update={"run": "f" * 32}))
    with pytest.raises(LogError, match="logs of 2 runs"):
        one_run([files[0], other])
    late = RunFile(files[1].path, files[1].metadata.model_copy(update={"first_input": 9}))
    with pytest.raises(LogError, match="begins with input 9, record 6; expected 4, 6"):
        list(read_run([files[0], late]))
