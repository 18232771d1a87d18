"""A disk that fails: what the log could not write is kept and written first to the next file, once."""

import io
import logging
from pathlib import Path
from typing import Any

import pytest
from disks import DiskOf, FullFile, StuckFile
from service_tools import WAIT_S, LoggedRun, events_of, inputs_of, read_back, starts_of

from roughmap_schemas.kinds import Kind
from roughmap_service.journal import writer as log_writer
from roughmap_service.journal.items import Sync
from roughmap_service.journal.records import LogRecord


def test_what_a_full_disk_would_not_take_is_first_in_the_next_file(tmp_path: Path) -> None:
    disk = DiskOf(FullFile)

    with LoggedRun(tmp_path, open_file=disk.open) as run:
        run.scan(0.0)
        assert run.writer.wait_synced(WAIT_S)
        disk.files[0].limit = disk.files[0].tell()
        events = [run.scan(1.0), run.scan(2.0)]
        assert run.writer.wait_synced(WAIT_S), "what was put before is on the disk in the end"
        assert run.writer.wait_room(WAIT_S)
        assert run.writer.error == ""
    items = read_back(tmp_path)
    assert len(starts_of(items)) == len(disk.files) == 2
    assert [item.number for item in inputs_of(items)] == list(range(1, 10))
    assert events_of(items)[1:] == events


@pytest.mark.parametrize("broken", [False, True])
def test_a_disk_that_hangs_is_one_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, broken: bool
) -> None:
    """From when that is seen on until it answers; each told once. It may answer that it is broken."""
    disk = DiskOf(StuckFile)

    monkeypatch.setattr(log_writer, "HANG_SECONDS", 0.0)
    caplog.set_level(logging.INFO)
    answers: list[str] = []
    output = LogRecord(Kind.QUERIES, "maps/site/queries", b"{}", 0, 0)
    with LoggedRun(tmp_path, open_file=disk.open) as run:
        run.scan(0.0)
        assert run.writer.wait_synced(WAIT_S)
        run.writer.look()
        assert run.writer.ok, "a disk that is asked for nothing does not hang"
        disk.files[0].broken = broken
        disk.files[0].free.clear()
        run.scan(1.0)
        run.writer.put(Sync(lambda: answers.append("early"), answers.append))
        assert disk.files[0].asked.wait(WAIT_S)
        assert run.writer.ok, "nobody looked"
        for _ in range(2):
            run.writer.look()
        assert run.writer.error == f"{run.writer.path}: its disk has not answered for 0 s"
        assert not run.writer.wait_room(0.0)
        assert not run.writer.put_output(output)
        run.writer.put(Sync(lambda: answers.append("late"), answers.append))
        assert answers == [run.writer.error] * 2, "who waited is told, and who asks now, at once"
        disk.files[0].free.set()
        assert run.writer.wait_room(WAIT_S)
        assert run.writer.wait_synced(WAIT_S)
        assert (run.writer.ok, run.writer.error, len(disk.files)) == (True, "", 1 + broken)
        assert len(answers) == 2, "each was told once"
    told = [record.event for record in caplog.records if record.name == log_writer.__name__]  # type: ignore[attr-defined]
    assert told == ["degraded", *(["degraded"] if broken else []), "recovered"]
    assert [item.number for item in inputs_of(read_back(tmp_path))] == list(range(1, 7))


def test_a_disk_without_room_for_a_footer_gets_no_more_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Though it has room for another beginning: all is in the file, and the next start gives it its footer."""
    disk = DiskOf(FullFile)

    with LoggedRun(tmp_path, open_file=disk.open) as run:
        event = run.scan(0.0)
        assert run.writer.wait_synced(WAIT_S)
        disk.files[0].limit = disk.files[0].tell()
        assert run.writer.close(WAIT_S), "nothing is lost"
    assert len(disk.files) == 1
    assert [record.message for record in caplog.records if "footer" in record.message]
    assert events_of(read_back(tmp_path))[-1:] == [event]


def test_a_file_is_made_again_if_memory_ran_out_at_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left of it must not be in the way of the next try, which takes the same name."""
    opened: list[Path] = []

    def open_file(path: Path) -> Any:
        class File(io.FileIO):
            def write(self, data: Any) -> int:
                if len(opened) == 2:
                    raise MemoryError
                return super().write(data)

        opened.append(path)
        return io.BufferedWriter(File(path, "xb"))

    monkeypatch.setattr(log_writer, "RETRY_SECONDS", 0.01)
    with LoggedRun(tmp_path, open_file=open_file) as run:
        run.scan(0.0)
        run.rotate()
        run.scan(1.0)
        assert run.writer.wait_synced(WAIT_S)
        assert run.writer.wait_room(WAIT_S)
        assert run.writer.index == 1
    assert [item.number for item in inputs_of(read_back(tmp_path))] == list(range(1, 7))
