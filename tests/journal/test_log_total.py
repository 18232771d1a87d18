"""The bytes that all files of a start have, and what is free on their disk, as the log itself knows them."""

import os
from pathlib import Path

import pytest
from disks import FailingDisk
from service_tools import WAIT_S, LoggedRun

from roughmap_service.journal import file_sequence
from roughmap_service.journal import writer as log_writer


def on_disk(directory: Path) -> int:
    return sum(path.stat().st_size for path in directory.glob("*.mcap"))


def test_all_files_count_but_for_their_footers(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs) as run:
        for k in range(3):
            run.scan(float(k), 0.3 * k)
            assert run.writer.wait_synced(WAIT_S)
            before = run.writer.total
            closed = on_disk(logs)
            run.rotate()
            assert run.writer.wait_synced(WAIT_S)
            assert run.writer.total > before, "it never falls"
            footers = on_disk(logs) - run.writer.total
            assert 0 <= footers < 20_000 * (k + 1)
            assert on_disk(logs) >= closed
        assert len(list(logs.glob("*.mcap"))) == 4


def test_a_disk_that_fails_makes_no_growth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each try a file is begun and removed."""
    monkeypatch.setattr(log_writer, "RETRY_SECONDS", 0.001)
    disk = FailingDisk()
    with LoggedRun(tmp_path / "log", open_file=disk.open) as run:
        run.scan(0.0)
        assert run.writer.wait_synced(WAIT_S)
        before = run.writer.total
        disk.broken = True
        run.scan(1.0, 0.3)
        while run.writer.ok:
            run.writer.wait_synced(0.05)
        assert run.writer.total == before
        disk.broken = False
        assert run.writer.wait_room(WAIT_S)
        assert run.writer.wait_synced(WAIT_S)
        assert before < run.writer.total <= on_disk(tmp_path / "log")


def test_what_is_free_is_what_the_system_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_sequence, "LOOK_SECONDS", 0.0)
    with LoggedRun(tmp_path / "log") as run:
        found = os.statvfs(tmp_path)
        assert run.writer.free == pytest.approx(found.f_bavail * found.f_frsize, rel=0.1)

        def fails(_: object) -> None:
            raise OSError

        monkeypatch.setattr(file_sequence.shutil, "disk_usage", fails)
        assert run.writer.wait_synced(WAIT_S)
        assert run.writer.free is None
