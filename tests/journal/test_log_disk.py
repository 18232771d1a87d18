"""A disk that fails at any place: in the end all is there once, in order, and no more was promised than was held."""

import errno
import io
import logging
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from disks import FailingDisk, FailingFile
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from properties import examples
from service_tools import T0, WAIT_S, inputs_of, metadata, odometry, read_back, starts_of

from roughmap_schemas.kinds import Kind
from roughmap_service.journal import writer as log_writer
from roughmap_service.journal.file import file_name
from roughmap_service.journal.items import Rotate, Sync
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter

RUN = metadata().run


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_writer, "RETRY_SECONDS", 0.001)


def record(number: int) -> LogRecord:
    return LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(number / 10), T0, T0 + number, number)


def numbers_on(directory: Path) -> list[int]:
    return [item.number for item in inputs_of(read_back(directory))]


class Noticed(logging.Handler):
    """Set once the writer has told that the log can't be written."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.event = threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.event.set()

    def wait(self) -> None:
        assert self.event.wait(WAIT_S), "the writer noticed nothing"


@pytest.fixture
def noticed() -> Iterator[Noticed]:
    handler = Noticed()
    log_writer.logger.addHandler(handler)
    yield handler
    log_writer.logger.removeHandler(handler)


operations = st.tuples(st.sampled_from(["open", "write", "fsync"]), st.integers(1, 25))


@examples(25, HealthCheck.function_scoped_fixture)
@given(faults=st.sets(operations, max_size=8), syncs=st.sets(st.integers(1, 30)), rotations=st.sets(st.integers(1, 30)))
def test_nothing_is_lost_or_doubled_wherever_it_fails(
    tmp_path_factory: pytest.TempPathFactory, faults: set[tuple[str, int]], syncs: set[int], rotations: set[int]
) -> None:
    """Every place but the very first file's beginning, where there is no log yet that could be kept."""
    directory = tmp_path_factory.mktemp("log")
    disk = FailingDisk(*faults)
    disk.works = True
    held: dict[int, list[int]] = {}

    def synced(number: int) -> Sync:
        return Sync(lambda: held.update({number: numbers_on(directory)}))

    with LogWriter(directory, metadata(), open_file=disk.open) as writer:
        disk.works = False
        for number in range(1, 31):
            writer.put(record(number))
            if number in syncs:
                writer.put(synced(number))
            if number in rotations:
                writer.put(Rotate("0" * 32))
        assert writer.wait_synced(WAIT_S)
        assert writer.wait_room(WAIT_S)
        assert (writer.ok, writer.error) == (True, "")
        disk.works = True
    assert writer.ok
    assert numbers_on(directory) == list(range(1, 31))
    assert [item.payload for item in inputs_of(read_back(directory))] == [record(n).payload for n in range(1, 31)]
    assert sorted(held) == sorted(syncs)
    for number, seen in held.items():
        assert seen[:number] == list(range(1, number + 1)), "what was promised was on the disk"


@pytest.mark.parametrize("what", ["open", "write", "fsync"])
def test_a_disk_that_fails_at_the_start(tmp_path: Path, what: str) -> None:
    """There is no log yet to keep: the caller gets the error, and no half file is left."""
    with pytest.raises(OSError, match="no room"):
        LogWriter(tmp_path, metadata(), open_file=FailingDisk((what, 1)).open)
    assert list(tmp_path.iterdir()) == []


def test_while_it_fails(tmp_path: Path, noticed: Noticed) -> None:
    """It says so, drops outputs, promises nothing; afterwards it goes on by itself."""
    disk = FailingDisk()
    with LogWriter(tmp_path, metadata(), open_file=disk.open) as writer:
        writer.put(record(1))
        assert writer.wait_synced(WAIT_S)
        disk.broken = True
        done = threading.Event()
        writer.put(record(2))
        writer.put(Sync(done.set))
        noticed.wait()
        assert "no room" in writer.error
        assert not writer.wait_room(0.0)
        assert not writer.put_output(record(0))
        assert not writer.wants_rotation()
        assert not done.is_set()
        disk.broken = False
        assert done.wait(WAIT_S)
        assert writer.wait_room(WAIT_S)
        assert writer.error == ""
        assert writer.put_output(record(0)), "outputs are taken again"
    starts = [start.metadata for start in starts_of(read_back(tmp_path))]
    assert [(m.index, m.first_input, m.first_record, m.base_digest) for m in starts] == [(0, 1, 1, ""), (1, 2, 2, "")]


def test_after_a_failure_the_log_is_writable_before_a_sync_is_confirmed(tmp_path: Path, noticed: Noticed) -> None:
    """What follows a sync may be the next message, which must not be refused for a failure that is over."""
    disk, seen, done = FailingDisk(), list[bool](), threading.Event()
    with LogWriter(tmp_path, metadata(), open_file=disk.open) as writer:
        disk.broken = True
        writer.put(record(1))
        writer.put(Sync(lambda: (seen.append(writer.ok), done.set())))
        noticed.wait()
        disk.broken = False
        assert done.wait(WAIT_S)
    assert seen == [True]


def test_an_end_while_it_fails(tmp_path: Path) -> None:
    """It ends in time and says that not all was kept; what was synced is there."""
    disk = FailingDisk()
    writer = LogWriter(tmp_path, metadata(), open_file=disk.open)
    writer.put(record(1))
    assert writer.wait_synced(WAIT_S)
    disk.broken = True
    writer.put(record(2))
    assert not writer.close(WAIT_S)
    assert numbers_on(tmp_path) == [1]


def test_a_file_that_is_in_the_way_stays(tmp_path: Path, noticed: Noticed) -> None:
    """The next file's name is taken by something that isn't ours: no log is worth deleting it."""
    other = tmp_path / file_name(RUN, 1)
    other.write_bytes(b"another's")
    with LogWriter(tmp_path, metadata()) as writer:
        writer.put(record(1))
        writer.put(Rotate("0" * 32))
        noticed.wait()
        assert other.name in writer.error
        assert other.read_bytes() == b"another's"
        other.rename(tmp_path / "moved")
        writer.put(record(2))
        assert writer.wait_synced(WAIT_S)
    assert numbers_on(tmp_path) == [1, 2]


def test_tries_that_fail_leave_no_files(tmp_path: Path, noticed: Noticed) -> None:
    """A disk that takes a file's beginning, and never what was to follow: it must not fill with beginnings."""
    tries: list[Path] = []
    enough = threading.Event()

    class Small(FailingFile):
        def write(self, data: Any) -> int:
            if self.disk.broken and self.tell() + len(data) > 20_000:
                raise OSError(errno.ENOSPC, "no room")
            return super().write(data)

    disk = FailingDisk()
    disk.works = True

    def open_file(path: Path) -> Any:
        raw = Small(path, "xb")
        raw.disk = disk
        tries.append(path)
        if len(tries) > 5:
            enough.set()
        return io.BufferedWriter(raw)

    payload = b"x" * 30_000
    with LogWriter(tmp_path, metadata(), open_file=open_file) as writer:
        writer.put(record(1))
        assert writer.wait_synced(WAIT_S)
        disk.broken = True
        writer.put(LogRecord(Kind.ODOMETRY, "robots/rover/odometry", payload, T0, T0 + 2, 2))
        noticed.wait()
        assert enough.wait(WAIT_S)
        assert len(list(tmp_path.glob("*.mcap"))) <= 2, "the first, and the one that is tried now"
        disk.broken = False
        assert writer.wait_synced(WAIT_S)
    assert numbers_on(tmp_path) == [1, 2]
    assert len(list(tmp_path.glob("*.mcap"))) == 2
