"""Killed as a file's footer was written and not yet on the disk, started again, and then the power is cut."""

import errno
import os
import random
from collections.abc import Callable
from pathlib import Path

import paths  # noqa: F401 - before what it makes importable
import pytest
from cut_states import DiskTree
from journals import DIES, journal_of
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from service_tools import WAIT_S, LoggedRun, config, inputs_of, read_back
from shim import Shim

from roughmap_service.engine.recovery import recover
from roughmap_service.host.disk import make_directory

CUTS = 60
"""So many states of what was not synced: about one in eight has the footer's end and not its beginning."""


def run_until_the_footer(directory: Path) -> None:
    """A run whose process dies between the footer's write and its fsync."""
    make_directory(directory)
    with LoggedRun(directory) as run:
        for k in range(20):  # so that the summary is written in several pieces
            run.scan(float(k), 0.3 * k, robot=f"robot{k}")
        assert run.writer.wait_synced(WAIT_S)
        real, calls = os.fsync, iter(range(10))

        def fsync(handle: int) -> None:
            if next(calls):
                os._exit(DIES)
            real(handle)

        os.fsync = fsync  # first the records' sync, then the footer's


def go_on(directory: Path) -> None:
    """A start after that, which logs more and is killed."""
    run = LoggedRun(directory, recovered=recover(config(), directory, None))
    run.scan(30.0)
    assert run.writer.wait_synced(WAIT_S)
    os._exit(DIES)


def leave_a_file_behind(directory: Path) -> None:
    """A run whose disk takes a file's records and then fails to keep them: it goes on in another, and is killed."""
    make_directory(directory)
    run = LoggedRun(directory)
    run.scan(0.0)
    assert run.writer.wait_synced(WAIT_S)
    real, faults = os.fsync, iter([OSError(errno.EIO, "Input/output error")])

    def fsync(handle: int) -> None:
        for fault in faults:
            raise fault
        real(handle)

    os.fsync = fsync
    run.scan(1.0)
    assert run.writer.wait_synced(WAIT_S)
    assert run.writer.index == 1
    os._exit(DIES)


@pytest.mark.parametrize(
    ("steps", "logged"),
    [([run_until_the_footer], 60), ([run_until_the_footer, go_on], 63), ([leave_a_file_behind], 6)],
    ids=["cut", "start, cut", "left behind, cut"],
)
def test_what_is_gone_on_from_is_on_the_disk(tmp_path: Path, steps: list[Callable[[Path], None]], logged: int) -> None:
    """And whatever of a footer the cut left, every reader finds its way in the file after the start."""
    shim = Shim(tmp_path / "shim", journal=True)
    calls = journal_of(shim, *steps)
    whole = [one.payload for one in inputs_of(read_back(shim.root / "log"))]
    assert len(whole) == logged
    disk = DiskTree(shim.root)
    for call in calls:
        disk.take(call)
    rng = random.Random(1)
    for cut in range(CUTS):
        left = tmp_path / f"left{cut}"
        disk.top.write(left, rng)
        recover(config(), left / "log", None)
        assert [one.payload for one in inputs_of(read_back(left / "log"))] == whole
        for path in (left / "log").glob("*.mcap"):
            with path.open("rb") as stream:
                assert sum(1 for _ in StreamReader(stream, validate_crcs=True).records) > 1
                stream.seek(0)
                assert make_reader(stream).get_summary() is not None
