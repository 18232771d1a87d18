"""`log.keep`: the oldest files go first, over all runs of the directory; what is needed or foreign never goes."""

from pathlib import Path

import pytest
from service_tools import SECOND, T0, WAIT_S, LoggedRun, metadata

from roughmap_schemas.kinds import Kind
from roughmap_service.journal.items import Rotate
from roughmap_service.journal.keep import Needed, delete_oldest
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.run_files import find_files
from roughmap_service.journal.writer import LogWriter
from roughmap_service.store.map_db import Cut
from roughmap_service.store.snapshots import cut_of


def three_files(run: LoggedRun) -> Cut:
    """Two scans, each with a file, and the file that is written to; where the run stands then."""
    for t in range(2):
        run.scan(float(t))
        run.rotate()
    assert run.writer.wait_synced(WAIT_S)
    return run.cut()


def needed(cut: Cut) -> Needed:
    """What a snapshot of that cut needs of the log."""
    return Needed(cut.run, cut.record, cut.low_water)


@pytest.mark.parametrize(("keep", "left"), [(0, 1), (1 << 40, 3)])
def test_keep_deletes_oldest_files_that_the_cut_spares(tmp_path: Path, keep: int, left: int) -> None:
    with LoggedRun(tmp_path) as run:
        cut = three_files(run)
        delete_oldest(run.writer.path, needed(cut), keep)
        assert len(find_files([tmp_path])) == left


def test_what_the_cut_needs_stays_and_other_runs_do_not(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as old:
        three_files(old)
    with LoggedRun(tmp_path, created_ns=T0 + SECOND) as run:
        early = run.cut()
        three_files(run)
        delete_oldest(run.writer.path, needed(early), 0)
        assert [file.metadata.run for file in find_files([tmp_path])] == [run.run_id] * 3


def test_runs_go_by_their_age_and_not_by_their_names(tmp_path: Path) -> None:
    """Each of three names is the oldest run's once."""
    names = sorted(f"{digit}" * 32 for digit in "5af")
    for ages in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        directory = tmp_path / str(ages)
        files: dict[int, list[Path]] = {}
        for age in range(3):
            run = LoggedRun(directory, created_ns=T0 + age * SECOND)
            with run:
                cut = three_files(run)
                current = run.writer.path
            own = sorted(directory.glob(f"roughmap-{run.run_id}-*.mcap"))
            name = names[ages[age]]
            files[age] = [path.rename(directory / path.name.replace(run.run_id, name)) for path in own]
            current, cut = files[age][-1], cut_of(name, run.config, run.run)
        spared = sum(path.stat().st_size for path in files[1][1:] + files[2])
        assert delete_oldest(current, needed(cut), spared) == [*files[0], files[1][0]]
        assert delete_oldest(current, needed(cut), 0) == [*files[1][1:], *files[2][:2]]
        assert list(directory.iterdir()) == [current]


def test_what_a_repair_left_goes_with_its_file_and_what_is_foreign_stays(tmp_path: Path) -> None:
    foreign = [tmp_path / name for name in ("walk.mcap", "roughmap-notes.mcap", "roughmap-5.mcap.torn")]
    for path in foreign:
        path.write_bytes(bytes(1 << 16))
    unread = tmp_path / f"roughmap-{'0' * 32}-000000.mcap"  # of which only its name tells that it is ours
    unread.write_bytes(b"damaged")
    with LoggedRun(tmp_path) as run:
        cut = three_files(run)
        first = tmp_path / f"roughmap-{run.run_id}-000000.mcap"
        behind, torn = (first.with_name(first.name + end) for end in (".behind", ".torn.1"))
        for path in (behind, torn):
            path.write_bytes(bytes(1 << 16))
        total = sum(path.stat().st_size for path in tmp_path.glob(f"roughmap-{run.run_id}*"))
        gone = delete_oldest(run.writer.path, needed(cut), total - first.stat().st_size - 1)
        assert [path for path in gone if path != unread] == [first, behind]
        delete_oldest(run.writer.path, needed(cut), 0)
        assert {*tmp_path.iterdir()} == {*foreign, run.writer.path}


def test_a_file_that_cannot_go_ends_it(tmp_path: Path) -> None:
    """A later one would leave a gap."""
    with LoggedRun(tmp_path) as run:
        cut = three_files(run)
        second = tmp_path / f"roughmap-{run.run_id}-000001.mcap"
        second.write_bytes(b"damaged")
        assert delete_oldest(run.writer.path, needed(cut), 0) == []


def test_a_file_is_full_by_what_is_held_for_it_too(tmp_path: Path) -> None:
    """The disk is asked to keep all once a second only: a second's messages would come on top."""
    with LogWriter(tmp_path, metadata(), max_file_bytes=1 << 20) as writer:
        assert not writer.wants_rotation()
        writer.put(LogRecord(Kind.QUERIES, "maps/site/queries", bytes(1 << 20), T0, T0))
        assert writer.wants_rotation(), "before the disk was asked"
        assert writer.wait_synced(WAIT_S)
        assert writer.wants_rotation()
        writer.put(Rotate(""))
        assert not writer.wants_rotation(), "it is asked for"
        assert writer.wait_synced(WAIT_S)
        assert not writer.wants_rotation(), "the next file is empty"
