"""A disk that is slower than what comes in: the log's queue stays within its limit, and the run goes before outputs."""

import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from disks import DiskOf, StuckFile
from net import Gathered, wait_for
from sequencers import ample_memory, sequencer_of
from service_tools import T0, WAIT_S, LoggedRun, cloud, metadata

from roughmap_schemas.kinds import Kind
from roughmap_service.engine.live_run import LiveRun
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.journal.items import RECORD_OVERHEAD, Sync
from roughmap_service.journal.recorder import Recorder
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter

LIMIT = 10_000
CLOUDS = 100
"""Of a kilobyte each: ten times the limit."""


def test_the_queue_has_its_limit_and_half_of_it_is_the_runs_alone(tmp_path: Path) -> None:
    disk = DiskOf(StuckFile)
    thousand = LogRecord(Kind.QUERIES, "maps/site/queries", bytes(1000 - RECORD_OVERHEAD), T0, T0)
    with LogWriter(tmp_path, metadata(), queue_limit=LIMIT, open_file=disk.open) as writer:
        (file,) = disk.files
        file.free.clear()
        writer.put(thousand)
        writer.put(Sync(lambda: None))
        wait_for(file.asked, "the disk to be asked")
        outputs = sum(writer.put_output(thousand) for _ in range(20))
        run = 0
        while run < 20 and writer.wait_room(0.0):
            writer.put(thousand)
            run += 1
        assert (outputs, run) == (3, 6), "to half of the limit, and to all of it"
        file.free.set()
        assert writer.wait_room(WAIT_S)
        assert writer.wait_synced(WAIT_S)
        assert writer.put_output(thousand)


def test_what_comes_in_waits_for_the_disk_and_takes_no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits where it is bounded and counted: before it is taken up."""
    disk, decided = DiskOf(StuckFile), Gathered[bytes]()
    monkeypatch.setattr("service_tools.LogWriter", partial(LogWriter, queue_limit=LIMIT))
    with LoggedRun(tmp_path / "log", open_file=disk.open) as run, ample_memory(tmp_path) as enough:
        writer, full, held = run.writer, threading.Event(), []
        wait_room, put = writer.wait_room, writer.put

        def waiting(timeout: float) -> bool:
            if timeout and writer.held >= LIMIT:
                full.set()
            return wait_room(timeout)

        def putting(item: Any) -> None:
            put(item)
            held.append(writer.held)

        monkeypatch.setattr(writer, "wait_room", waiting)
        monkeypatch.setattr(writer, "put", putting)
        intake, counters = InputQueue(1 << 20, Counters()), Counters()
        live = LiveRun(
            run.run,
            run.view,
            writer,
            Recorder(writer, run.keys),
            counters,
            enough,
            run.streams,
            decided,
            run.emptied.note,
        )
        sequencer = sequencer_of(live, intake, writer, enough)
        for number in range(CLOUDS):
            payload = cloud(number, frame="map", points=np.ones((36, 3)))
            intake.put(InputMessage(Kind.POINTS, "rover", payload, T0, 0.0))
        disk.files[0].free.clear()
        sequencer.start()
        wait_for(full, "the queue to be full, and the sequencer to wait")
        disk.files[0].free.set()
        decided.wait(lambda events: len(events) >= CLOUDS, "all clouds")
        assert sequencer.stop(WAIT_S)
        assert LIMIT <= max(held) < LIMIT + 2000, "a cloud more, or an event"
