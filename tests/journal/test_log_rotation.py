"""A run over several files: their numbers, their bases, and when a file wants its end."""

from pathlib import Path
from typing import Any

import pytest
from service_tools import T0, WAIT_S, LoggedRun, events_of, inputs_of, metadata, odometry, read_back, starts_of

from roughmap_schemas.kinds import Kind
from roughmap_service.journal.items import Rotate
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter


def point(number: int, received: int, stamp: int = T0) -> LogRecord:
    return LogRecord(Kind.ODOMETRY, "robots/rover/odometry", odometry(0.0), received, stamp, number)


def test_numbers_go_on_over_files(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as run:
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
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"roughmap-{run.run_id}-{n:06d}.mcap" for n in range(3)]


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
