"""A disk that takes its time over a tile, in the spill file or in the store: only who needs that tile waits for it."""

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net import WAIT_S, Gathered, wait_for
from sequencers import sequencer_of
from service_tools import T0, LoggedRun, cloud, config
from spill_tools import leave

from roughmap_schemas import IntegrationEvent, decode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.tiles import TileQueries
from roughmap_service.engine.live_run import LiveRun
from roughmap_service.engine.recovery import recover
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.offline.replay import replay
from roughmap_service.store.map_db import Store
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.spill import SLICE_BYTES, Spill
from roughmap_service.watch.status import RunProgress, Status

NEAR, FAR, FARTHER, FARTHEST = 0, 10, 20, 30
"""Tiles, each alone: the first is in memory, the others are not."""


class ReadStop:
    """Once told to, it stops at the next tile that it shall read, until it is let ``go``; at all others it does not."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.stopped, self.go = threading.Event(), threading.Event()
        self._stop = threading.Semaphore(0)
        disk, preadv = self, os.preadv

        def read(*args: Any) -> int:
            disk._pass()
            return preadv(*args)

        class Connection(sqlite3.Connection):
            def execute(self, sql: str, *args: Any) -> sqlite3.Cursor:
                if "state" in sql:
                    disk._pass()
                return super().execute(sql, *args)

        monkeypatch.setattr(os, "preadv", read)
        monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Connection))

    def stop(self) -> None:
        self._stop.release()

    def _pass(self) -> None:
        if self._stop.acquire(blocking=False):
            self.stopped.set()
            wait_for(self.go, "the disk to be let go")


def points_in(*tiles: int, t: float = 1.0) -> bytes:
    """A cloud with a point in each of these tiles."""
    return cloud(t, frame="map", points=np.array([[6.4 * x + 3.2, 3.2, t + x] for x in tiles]))


class ReadRun:
    """The sequencer of a run, and readers of its map."""

    def __init__(self, disk: ReadStop, run: LoggedRun, spill: Spill, stack: ExitStack) -> None:
        self.disk, self.run, self.map = disk, run, run.run.map
        self.decided: Gathered[IntegrationEvent] = Gathered()
        self.digests = {x: d.tobytes().hex() for x, d in zip(*self.map.tile_digests()[::2], strict=True)}
        self._intake, counters = InputQueue(1 << 20, Counters()), Counters()
        served = ServedMap("site", run.run_id, "0" * 32, "0" * 32, "map", "all")
        self._queries = TileQueries(MapReader(run.view, run.keys, run.config, served, EmptiedHistory(1000)))
        self.status = Status(run.view, counters, run.config, served, "1", RunProgress)
        self._taken = 0
        self._memory = MemoryLimit(1 << 20, spill, measure=lambda: self._taken)
        live = LiveRun(
            run.run,
            run.view,
            run.writer,
            run.recorder,
            counters,
            self._memory,
            run.streams,
            self._hear,
            run.emptied.note,
        )
        self._sequencer = sequencer_of(live, self._intake, run.writer, self._memory)
        self._pool = stack.enter_context(ThreadPoolExecutor(4))
        stack.callback(lambda: self._sequencer.stop(WAIT_S))
        stack.callback(disk.go.set)  # whatever fails, nobody is left standing there
        self._sequencer.start()

    def _hear(self, event: bytes) -> None:
        decoded = decode_event(event)
        if isinstance(decoded, IntegrationEvent):
            self.decided(decoded)

    def send(self, payload: bytes) -> None:
        self._intake.put(InputMessage(Kind.POINTS, "rover", payload, T0, time.monotonic()))

    def leave(self) -> None:
        """MemoryLimit is short until all tiles have left that can."""

        def relieve() -> None:
            self._taken = 1 << 40
            self._memory.relieve(self.run.view.reading)
            self._taken = 0

        self._sequencer.call(relieve, WAIT_S)

    def beside(self, work: Callable[[], Any]) -> Future[Any]:
        return self._pool.submit(work)

    def tell(self, *tiles: int) -> int:
        """Ask for these tiles as a planner does; how many came."""
        found = 0
        for x in tiles:
            with self._queries.plan(f"maps/site/tiles/0/{x}/0", "layers=count").read() as answer:
                found += len(list(answer.replies))
        return found

    def digest(self, tile: int) -> str:
        """Of the tile's bytes."""
        with self.run.view.freeze() as (frozen, _):
            return frozen.digest(tile, 0)


@contextmanager
def serving(where: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ReadRun]:
    """With all tiles but the near one in the spill file or in the store. The run's replay must come out equal."""
    store = Store(folder / "map.db")
    if where == "store":
        with LoggedRun(folder / "log", store=store) as before:
            before.put(Kind.POINTS, points_in(FAR, FARTHER, FARTHEST))
            before.decide()
            before.checkpoint()
            before.snapshot()
    disk = ReadStop(monkeypatch)
    with ExitStack() as stack:
        spill = stack.enter_context(Spill(folder / "tiles.spill", 100 * SLICE_BYTES))
        recovered = recover(config(), folder / "log", store, memory=MemoryLimit(1 << 40, spill))
        run = stack.enter_context(LoggedRun(folder / "log", recovered=recovered, store=store, spill=spill))
        if where == "spill":
            run.put(Kind.POINTS, points_in(FAR, FARTHER, FARTHEST))
            run.decide()
        run.put(Kind.POINTS, points_in(NEAR))
        run.decide()
        leave(run.run.map)
        assert (run.run.map.resident_tiles, spill.used) == (1, 3)
        yield ReadRun(disk, run, spill, stack)
    assert replay([folder / "log"]).run.map.digest() == run.run.map.digest()


@pytest.fixture(params=["spill", "store"])
def service(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ReadRun]:
    with serving(request.param, tmp_path, monkeypatch) as made:
        yield made


def test_while_the_writer_waits_for_the_disk_all_are_answered(service: ReadRun) -> None:
    sequence = service.map.sequence
    service.disk.stop()
    service.send(points_in(NEAR, FAR, t=2.0))
    wait_for(service.disk.stopped, "the cloud to need its tile")
    # From memory, from the disk, of the map itself; of what the cloud will change, as it was.
    assert service.beside(lambda: service.tell(NEAR, FARTHER)).result(WAIT_S) == 2
    assert service.beside(lambda: service.digest(FARTHEST)).result(WAIT_S) == service.digests[FARTHEST]
    assert service.beside(lambda: service.digest(FAR)).result(WAIT_S) == service.digests[FAR]
    assert service.beside(service.status).result(WAIT_S).sequence == sequence
    assert not service.decided.items
    service.disk.go.set()
    (event,) = service.decided.wait(lambda events: len(events) == 1, "the cloud")
    assert (event.accepted, event.sequence) == (2, sequence + 1)
    assert service.beside(lambda: service.digest(FAR)).result(WAIT_S) != service.digests[FAR]


def test_while_a_reader_waits_for_the_disk_the_map_and_other_readers_go_on(service: ReadRun) -> None:
    """Also when its tile comes back, changes and leaves again meanwhile."""
    service.disk.stop()
    waiting = service.beside(lambda: service.digest(FAR))
    wait_for(service.disk.stopped, "the reader to need its tile")
    service.send(points_in(FAR, FARTHER, t=2.0))
    service.decided.wait(lambda events: len(events) == 1, "a cloud on tiles of the disk")
    assert service.beside(lambda: service.tell(NEAR, FAR, FARTHEST)).result(WAIT_S) == 3
    service.send(points_in(NEAR, t=3.0))
    service.decided.wait(lambda events: len(events) == 2, "a cloud on a tile in memory")
    service.leave()
    assert service.map.resident_tiles == 0
    assert service.beside(lambda: service.digest(FARTHEST)).result(WAIT_S) == service.digests[FARTHEST]
    assert service.beside(lambda: service.digest(FAR)).result(WAIT_S) != service.digests[FAR]
    assert not waiting.done()
    service.disk.go.set()
    assert waiting.result(WAIT_S) == service.digests[FAR]
