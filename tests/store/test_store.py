"""The map on disk: whole cuts, written in one transaction, read back to the bit."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roughmap import CELL_DTYPE, RoughMap
from roughmap.cell import BASED, COLUMN_DTYPE, TRUST_DTYPE
from roughmap.tiles.state import TileState
from roughmap_service.store.map_db import Cut, DamagedStore, OtherStateVersion, Store, StoreError, tile_checksum
from roughmap_service.store.stored_tiles import read_index

CUT = Cut(
    run="a" * 32, epoch=3, sequence=1, input=17, record=20, low_water=12, configuration={"map": {"cell_size": 0.1}},
    configuration_digest="b" * 32, poses={"rover": {"poses": [[1, [0.1, 1e-300, -0.0], None]]}},
    duplicates=[["rover", "points", "c" * 32, 4]],
)  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "map.db")


@pytest.fixture
def ground() -> RoughMap:
    rough_map = RoughMap(error_model="point")
    spread = np.random.default_rng(1).uniform(-30, 30, (2000, 3))
    rough_map.add(spread, stamp_ns=5_000_000_007)
    return rough_map


def write(store: Store, rough_map: RoughMap, cut: Cut = CUT, after: int | None = None) -> None:
    with rough_map.freeze() as frozen:
        store.write(replace(cut, sequence=rough_map.sequence), frozen, after)


def read(store: Store) -> RoughMap:
    cut = store.read_cut()
    assert cut is not None
    rough_map = RoughMap(error_model="point")
    store.load_into(rough_map, cut)
    return rough_map


def test_a_cut_comes_back_as_it_was(store: Store, ground: RoughMap) -> None:
    write(store, ground)
    assert store.read_cut() == CUT
    back = read(store)
    assert (back.digest(), back.sequence) == (ground.digest(), ground.sequence)
    with ground.freeze() as was, back.freeze() as now:
        for x, y in was.tiles.tolist():
            assert now.records(x, y).tobytes() == was.records(x, y).tobytes()
            assert now.stamps(x, y) == was.stamps(x, y)


def test_only_what_changed_is_written(store: Store, ground: RoughMap) -> None:
    """Seen from a tile that was spoilt in the store: it stays so, for its cells did not change since."""
    write(store, ground)
    with closing(sqlite3.connect(store.path)) as db, db:
        spoilt = tile_checksum(np.array([-3, -3, 1, 5_000_000_007]))
        db.execute("UPDATE tiles SET oldest_ns = 1, checksum = ? WHERE tx = -3 AND ty = -3", (spoilt,))
    before = ground.sequence
    ground.add([[25.0, 25.0, 1.0]], stamp_ns=6_000_000_000)
    write(store, ground, after=before)
    oldest = {(tile.tx, tile.ty): tile.oldest_ns for tile in store.read_tiles()}
    assert oldest[-3, -3] == 1
    assert read(store).digest() == ground.digest()
    write(store, ground)
    assert {tile.oldest_ns for tile in store.read_tiles() if (tile.tx, tile.ty) == (-3, -3)} == {5_000_000_007}


def test_cells_trust_and_columns_come_back(store: Store) -> None:
    """Two tiles, of which one has a column."""
    rng = np.random.default_rng(4)
    states = []
    for with_column in (True, False):
        cells, trust, column = (np.zeros(4096, dtype) for dtype in (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE))
        known = rng.choice(4096, 900, replace=False)
        cells["count"][known], cells["mean"][known] = 1, rng.normal(size=900)
        trust["variance"][known], trust["stamp_ms"][known] = rng.uniform(size=900), 2**32 - 1
        column["flags"][known[:80]], column["bins"][known[:80]] = BASED, rng.integers(0, 256, (80, 40))
        states.append(TileState(cells, trust, column if with_column else None))
    was = RoughMap(error_model="point")
    for x, state in enumerate(states):
        was.load_tile(x, 0, state, 3, 4)
    write(store, was)
    back = read(store)
    assert back.digest() == was.digest()
    with back.freeze() as frozen:
        for x, state in enumerate(states):
            found = frozen.state(x, 0)
            assert found is not None
            assert [a.tobytes() for a in found.arrays] == [a.tobytes() for a in state.arrays]


def test_forgotten_tiles_are_deleted(store: Store, ground: RoughMap) -> None:
    """With the next write of what changed: the forgotten ones alone, not those that came anew."""
    write(store, ground)
    before, every = ground.sequence, {(tile.tx, tile.ty) for tile in store.read_tiles()}
    assert ground.forget([(-3, -3), (0, 0), (2, 1)]) == 3
    ground.add([[0.05, 0.05, 1.0]], stamp_ns=6_000_000_000)
    with ground.freeze(after=before) as frozen:
        cut = replace(CUT, sequence=ground.sequence)
        store.write(cut, frozen, before, remaining=ground.tile_sequences()[0])
    assert {(tile.tx, tile.ty) for tile in store.read_tiles()} == every - {(-3, -3), (2, 1)}
    back = read(store)
    assert (back.digest(), back.tile_count) == (ground.digest(), len(every) - 2)


def test_after_a_reset_nothing_old_is_left(store: Store, ground: RoughMap) -> None:
    write(store, ground)
    ground.reset()
    ground.add([[0.0, 0.0, 1.0]], stamp_ns=6_000_000_000)
    write(store, ground)
    assert [(tile.tx, tile.ty) for tile in store.read_tiles()] == [(0, 0)]


def test_a_failed_write_leaves_the_old_cut(store: Store, ground: RoughMap) -> None:
    write(store, ground)
    was = ground.digest()
    ground.add([[0.0, 0.0, 9.0]], stamp_ns=6_000_000_000)
    with pytest.raises(ValueError, match="JSON"):  # NaN is no JSON: the cut can't be written after the tiles were
        write(store, ground, replace(CUT, poses={"rover": float("nan")}))
    assert store.read_cut() == CUT
    assert read(store).digest() == was


def test_a_damaged_tile_is_named(store: Store, ground: RoughMap) -> None:
    write(store, ground)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE tiles SET digest = zeroblob(16) WHERE tx = 2 AND ty = 1")
    with pytest.raises(StoreError, match=r"map\.db: tile \(2, 1\) is damaged"):
        list(store.read_tiles())


@pytest.mark.parametrize("change", ["oldest_ns = 1", "newest_ns = newest_ns + 256", "checksum = x'00'", "tx = tx + 40"])
def test_a_damaged_stamp_is_named(store: Store, ground: RoughMap, change: str) -> None:
    write(store, ground)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute(f"UPDATE tiles SET {change} WHERE tx = 2 AND ty = 1")
    for read_again in (lambda: list(store.read_tiles()), lambda: read_index(store)):
        with pytest.raises(DamagedStore, match=r"map\.db: damaged \(the stamps of tile \(4?2, 1\)"):
            read_again()


def test_what_is_no_store(store: Store, ground: RoughMap) -> None:
    store.path.write_bytes(b"holiday pictures " * 100)
    with pytest.raises(StoreError, match=r"map\.db: .* not a map\.db"):
        store.read_cut()
    store.path.write_bytes(b"")  # as a kill leaves it between the file and its tables
    assert store.read_cut() is None
    write(store, ground)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE cut SET value = '{' WHERE name = 'poses'")
    with pytest.raises(StoreError, match="damaged"):
        store.read_cut()


def test_another_state_version(store: Store, ground: RoughMap) -> None:
    write(store, ground, replace(CUT, state_version=CUT.state_version + 1))
    with pytest.raises(OtherStateVersion, match="state version"):
        store.read_cut()


def test_set_aside_whole(store: Store, ground: RoughMap) -> None:
    write(store, ground)
    aside = store.set_aside("old")
    assert not store.exists()
    assert aside.name == "map.db.old"
    assert read(Store(aside)).digest() == ground.digest()
    assert list(store.path.parent.iterdir()) == [aside], "no write-ahead log of it is left behind"


def test_a_file_that_is_not_a_store_is_named_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "map.db"
    path.write_bytes(b"no database" * 1000)
    with pytest.raises(StoreError, match=r"map\.db: .*; not a map\.db, or damaged: .*move the file away"):
        Store(path).read_cut()
