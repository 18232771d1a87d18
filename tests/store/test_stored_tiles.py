"""Tiles lie in the store until they are needed, and in the spill file when they are not: the run goes on the same."""

import sqlite3
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_tools import WAIT_S, LoggedRun, cloud, config
from spill_tools import leave

from roughmap import RoughMap
from roughmap.reading.layers import layers_of
from roughmap.tiles.shelf import empty_state
from roughmap_schemas import IntegrationEvent
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import Recovered, recover
from roughmap_service.offline.replay import replay
from roughmap_service.store.map_db import Store, StoreError
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.spill import SLICE_BYTES, Spill
from roughmap_service.store.stored_tiles import StoredTiles, set_index

ALL = (-25.0, -25.0, 25.0, 25.0)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "map.db")


@pytest.fixture
def spills(tmp_path: Path) -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


class Lazy:
    """What a start with a spill file brings back."""

    def __init__(self, logs: Path, store: Store, stack: ExitStack) -> None:
        self.spill = stack.enter_context(Spill(logs / "tiles.spill", 1000 * SLICE_BYTES))
        self.memory = MemoryLimit(1 << 40, self.spill)
        self.recovered: Recovered = recover(config(), logs, store, memory=self.memory)
        self.map = self.recovered.run.map


def scan(run: LoggedRun, seed: int, reach: float = 22.0, number: int = 400) -> IntegrationEvent:
    """A cloud in the map's frame, over up to 8 x 8 tiles."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-reach, reach, (2, number))
    points = np.column_stack([x, y, 0.1 * x + 0.2 * np.sin(y)])
    run.put(Kind.POINTS, cloud(float(seed), frame="map", points=points))
    return run.decide()[-1]


def begun(logs: Path, store: Store) -> LoggedRun:
    """A run of three clouds, stored."""
    with LoggedRun(logs, store=store) as run:
        for seed in range(3):
            scan(run, seed)
        run.checkpoint()
        run.snapshot()
    return run


def seen(m: RoughMap) -> list[Any]:
    """Everything that a reader may ask, to the bit."""
    found: list[Any] = [m.sequence, m.newest_updated, m.tile_count, m.extent(), m.digest()]
    for level in range(m.levels):
        with m.freeze(level) as frozen:
            tiles = frozen.tiles.tolist()
            found.append((tiles, frozen.sequences.tolist(), [frozen.stamps(x, y) for x, y in tiles]))
            found.append([frozen.digest(x, y) for x, y in tiles])
    names = layers_of(m.settings.surface)
    found += [m.region(ALL, names, level)[name].tobytes() for level in (0, 2) for name in names]
    return found


def test_a_lazy_start_is_the_start_that_reads_all(logs: Path, store: Store, spills: ExitStack) -> None:
    begun(logs, store)
    eager = recover(config(), logs, store)
    lazy = Lazy(logs, store, spills)
    assert lazy.map.resident_tiles == 0
    assert seen(lazy.map) == seen(eager.run.map)
    assert lazy.map.resident_tiles == 0, "reading brings nothing into memory"
    assert lazy.recovered.cut == eager.cut


def test_only_what_is_needed_is_read(
    logs: Path, store: Store, spills: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(logs, store)
    read = []
    true = StoredTiles.read
    monkeypatch.setattr(StoredTiles, "read", lambda self, n, room: [read.append(n), true(self, n, room)][1])
    lazy = Lazy(logs, store, spills)
    assert lazy.map.digest()
    assert read == []
    report = lazy.map.add([[1.0, 1.0, 0.0], [1.2, 1.2, 0.0]], np.eye(3) * 1e-6, 10**9)
    assert len(read) == len(report.tiles) == lazy.map.resident_tiles == 1


def test_the_run_goes_on_from_stored_and_spilled_tiles(logs: Path, store: Store, spills: ExitStack) -> None:
    """Snapshots hold them as they are; the next start, which reads all, and a replay have the same map."""
    begun(logs, store)
    lazy = Lazy(logs, store, spills)
    with LoggedRun(logs, recovered=lazy.recovered, store=store, spill=lazy.spill) as run:
        for seed in range(3, 8):
            scan(run, seed, 4.0 * (8 - seed))
            leave(run.run.map)
            run.checkpoint()
            if seed % 2:
                run.snapshot()
        run.snapshot()
        assert run.run.map.resident_tiles < run.run.map.tile_count
        after = seen(run.run.map)
    cut = store.read_cut()
    assert cut is not None
    assert cut.sequence == after[0]
    again = recover(config(), logs, store)
    assert again.run.map.digest() == replay([logs]).run.map.digest() == after[4]


def test_a_reset_lets_stored_and_spilled_tiles_go(logs: Path, store: Store, spills: ExitStack) -> None:
    begun(logs, store)
    lazy = Lazy(logs, store, spills)
    with LoggedRun(logs, recovered=lazy.recovered, store=store, spill=lazy.spill) as run:
        scan(run, 3, 12.0)
        scan(run, 4, 1.0)
        assert leave(run.run.map)
        run.reset()
        assert lazy.spill.used == 0
        scan(run, 5, 3.0)
        run.checkpoint()
        run.snapshot()
    back = recover(config(), logs, store)
    assert back.run.map.digest() == run.run.map.digest() == replay([logs]).run.map.digest()


@pytest.mark.parametrize("patient", [True, False])
def test_a_snapshot_overwrites_nothing_that_is_still_read(
    logs: Path, store: Store, spills: ExitStack, monkeypatch: pytest.MonkeyPatch, patient: bool
) -> None:
    """A reading from before a change has its tiles in the store: the next snapshot waits for it, or is left out."""
    begun(logs, store)
    was = recover(config(), logs, store).run.map
    lazy = Lazy(logs, store, spills)
    with LoggedRun(logs, recovered=lazy.recovered, store=store, spill=lazy.spill) as run:
        held = run.run.map.freeze()
        scan(run, 3)
        run.checkpoint()
        if not patient:
            assert run.writer.wait_synced(WAIT_S)
            monkeypatch.setattr("roughmap_service.store.snapshots.SYNC_SECONDS", 0.0)
            monkeypatch.setattr(run.writer, "wait_synced", lambda _: True)
        thread = run.snapshots.offer(run.cut)
        assert thread is not None
        if not patient:
            thread.join(WAIT_S)
            assert "reader" in run.snapshots.error
        with was.freeze() as before:
            for x, y in before.tiles.tolist():
                assert held.digest(x, y) == before.digest(x, y)
        assert thread.is_alive() == patient, "it waits for the reading"
        with run.view.reading():
            held.close()
        thread.join(WAIT_S)
        if patient:
            assert not run.snapshots.error
        else:
            run.snapshot()
    assert recover(config(), logs, store).run.map.digest() == run.run.map.digest()


def test_a_tile_that_was_damaged_is_found_when_it_is_needed(logs: Path, store: Store, spills: ExitStack) -> None:
    begun(logs, store)
    with closing(sqlite3.connect(store.path)) as db, db:
        (blob,) = db.execute("SELECT state FROM tiles WHERE tx = 0 AND ty = -1").fetchone()
        db.execute("UPDATE tiles SET state = ? WHERE tx = 0 AND ty = -1", (blob[:-9] + bytes(9),))
    lazy = Lazy(logs, store, spills)
    was = lazy.map.digest()
    lazy.map.add([[-1.0, 1.0, 0.0]], np.eye(3) * 1e-6, 10**9)
    assert lazy.spill.failure == ""
    sequence = lazy.map.sequence
    with pytest.raises(StoreError, match=r"map\.db: tile \(0, -1\) is damaged"):
        lazy.map.add([[1.0, -1.0, 0.0]], np.eye(3) * 1e-6, 10**9)
    assert lazy.map.sequence == sequence
    with lazy.map.freeze() as frozen, pytest.raises(StoreError, match=r"tile \(0, -1\) is damaged"):
        frozen.records(0, -1)
    assert "(0, -1)" in lazy.spill.failure
    assert was != lazy.map.digest()


@pytest.mark.parametrize(
    "change", ["newest_ns = -1", "digest = zeroblob(3)", "tx = tx + 1000000000", "oldest_ns = 'noon'"]
)
def test_an_index_that_can_be_none(logs: Path, store: Store, spills: ExitStack, change: str) -> None:
    """The store is damaged: it is set aside and rebuilt from the log, and its tiles keep no place."""
    run = begun(logs, store)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute(f"UPDATE tiles SET {change}")
    lazy = Lazy(logs, store, spills)
    assert lazy.map.digest() == run.run.map.digest()
    assert lazy.spill.used == 0
    assert store.path.with_name("map.db.damaged").exists()


def test_where_the_log_ends_before_the_store_nothing_of_the_store_is_kept(
    logs: Path, store: Store, spills: ExitStack, tmp_path: Path
) -> None:
    with LoggedRun(logs, store=store) as run:
        scan(run, 0)
        run.checkpoint()
        left = run.killed(tmp_path / "left")
        scan(run, 1)
        run.checkpoint()
        run.snapshot()
    lazy = Lazy(left, store, spills)
    assert lazy.map.digest() == replay([left]).run.map.digest() != run.run.map.digest()
    assert lazy.map.resident_tiles == lazy.map.tile_count
    assert lazy.spill.used == 0


@pytest.mark.parametrize("number", [1025, 1600, 2048])
def test_many_stored_tiles_each_keep_their_own_cells(number: int, store: Store, tmp_path: Path) -> None:
    """More than the tables have at first: their places then come in another order than the tiles of the index."""
    side = 48
    n = np.arange(number)
    points = np.column_stack([(n % side) * 6.4 + 0.05, (n // side) * 6.4 + 0.05, n * 0.01])
    whole = RoughMap(error_model="point", threads=1)
    whole.add(points)
    store.write_map(whole, {}, "digest", "a" * 32)
    cut = store.read_cut()
    assert cut is not None
    with Spill(tmp_path / "tiles", 10 * SLICE_BYTES) as spill:
        failed = StoredTiles(store)
        spill.release(spill.adopt(failed))  # the places of a start that failed come back in yet another order
        stored = StoredTiles(store)
        lazy = RoughMap(error_model="point", threads=1, shelf=spill)
        set_index(lazy, cut, stored, spill.adopt(stored))
        with whole.freeze() as true, lazy.freeze() as found:
            assert found.tiles.tolist() == true.tiles.tolist()
            for x, y in true.tiles.tolist():
                assert found.records(x, y).tobytes() == true.records(x, y).tobytes(), (x, y)
        for m in whole, lazy:
            m.add(points[::7])
        assert lazy.digest() == whole.digest()


def test_a_snapshot_that_closes_locks_no_reader_out(logs: Path, store: Store, spills: ExitStack) -> None:
    """SQLite writes its log back, with all readers locked out, when the last connection closes."""
    begun(logs, store)
    lazy = Lazy(logs, store, spills)
    with LoggedRun(logs, recovered=lazy.recovered, store=store, spill=lazy.spill) as run:
        run.put(Kind.POINTS, cloud(3.0, 500.0, frame="map"))  # no stored tile is read for it
        run.decide()
        run.snapshot()
        assert store.path.with_name("map.db-wal").stat().st_size, "another is open"


def test_a_tile_for_which_there_is_no_memory_is_not_a_damaged_one(
    logs: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(logs, store)

    class Full:
        def execute(self, *_: Any) -> Any:
            raise MemoryError

        def close(self) -> None:
            pass

    with closing(StoredTiles(store)) as stored:
        room = empty_state()
        with monkeypatch.context() as patch:
            patch.setattr(stored, "_idle", deque([Full()]))
            with pytest.raises(MemoryError):
                stored.read(0, room)
        stored.read(0, room)
        assert room.cells["count"].any()
