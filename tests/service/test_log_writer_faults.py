"""A disk that fails: what the log could not write is kept and written first to the next file, once."""

import errno
import io
from pathlib import Path
from typing import Any

import pytest
from service_tools import WAIT_S, Run, events_of, inputs_of, read_back, starts_of

from roughmap_service.log_keep import delete_oldest
from roughmap_service.log_reader import find_files
from roughmap_service.snapshots import cut_of


class FullDisk(io.FileIO):
    """A file that has no room past ``limit`` bytes."""

    limit = 1 << 40

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.limit:
            raise OSError(errno.ENOSPC, "No space left on device", str(self.name))
        return super().write(data)


def test_what_a_full_disk_would_not_take_is_first_in_the_next_file(tmp_path: Path) -> None:
    opened: list[FullDisk] = []

    def open_file(path: Path) -> Any:
        opened.append(FullDisk(path, "xb"))
        return io.BufferedWriter(opened[-1])

    with Run(tmp_path, open_file=open_file) as run:
        run.scan(0.0)
        assert run.writer.wait_synced(WAIT_S)
        opened[0].limit = opened[0].tell()
        events = [run.scan(1.0), run.scan(2.0)]
        assert run.writer.wait_synced(WAIT_S), "what was put before is on the disk in the end"
        assert run.writer.wait_room(WAIT_S)
        assert run.writer.error == ""
    items = read_back(tmp_path)
    assert len(starts_of(items)) == len(opened) == 2
    assert [item.number for item in inputs_of(items)] == list(range(1, 10))
    assert events_of(items)[1:] == events


@pytest.mark.parametrize(("keep", "left"), [(0, 1), (1 << 40, 3)])
def test_keep_deletes_oldest_files_that_the_cut_spares(tmp_path: Path, keep: int, left: int) -> None:
    with Run(tmp_path) as run:
        for t in range(2):
            run.scan(float(t))
            run.rotate()
        assert run.writer.wait_synced(WAIT_S)
        early = cut_of("0" * 32, run.config, run.state, run.inbox, run.duplicates)
        assert delete_oldest(tmp_path, early, 0) == [], "files of another run are not its business"
        delete_oldest(tmp_path, cut_of(run.run, run.config, run.state, run.inbox, run.duplicates), keep)
        assert len(find_files([tmp_path])) == left
