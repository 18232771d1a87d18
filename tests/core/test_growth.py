"""Growing tables: ordered for any order of insertion, and unchanged if memory runs out."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap import RoughMap
from roughmap.tiles import digest
from roughmap.tiles import table as tiles
from roughmap.tiles.index import LevelIndex
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.slabs import SLAB_PLACES
from roughmap.tiles.slots import SLOT_BYTES, SlotPool
from roughmap.tiles.table import TileTable

TILE = st.tuples(st.integers(-(2**25), 2**25 - 1), st.integers(-3, 3))


def failing(number: int, true: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function ``true``, which raises MemoryError at call ``number``."""
    calls = iter(range(1000))

    def call(*args: Any) -> Any:
        if next(calls) == number:
            raise MemoryError
        return true(*args)

    return call


@examples(50)
@given(st.lists(st.lists(TILE, max_size=40), max_size=8))
def test_tiles_are_sorted_for_any_order_of_insertion(rounds: list[list[tuple[int, int]]]) -> None:
    index = LevelIndex()
    known: dict[tuple[int, int], int] = {}
    for number, came in enumerate(rounds):
        before, was = index.versions(), sorted(known.items())
        tx, ty = np.array([*came, (0, 0)], np.int32).T
        index.insert(tx, ty)
        for entry in range(index.size):
            if known.setdefault((int(index.tx[entry]), int(index.ty[entry])), number) == number:
                index.sequence[entry] = number
        x, y, sequence = index.select()
        assert list(zip(zip(x.tolist(), y.tolist(), strict=True), sequence.tolist(), strict=True)) == sorted(
            known.items()
        )
        changed = index.changed(number - 1)
        assert list(zip(index.tx[changed].tolist(), index.ty[changed].tolist(), strict=True)) == sorted(
            tile for tile, when in known.items() if when == number
        )
        then, theirs = before.select()
        assert [((x, y), s) for (x, y), s in zip(then.tolist(), theirs.tolist(), strict=True)] == was


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("dense", [False, True])
def test_slots_stay_where_their_memory_is(monkeypatch: pytest.MonkeyPatch, number: int, dense: bool) -> None:
    pool = SlotPool()
    pool.allocate(SLAB_PLACES)
    flags = np.full(SLAB_PLACES, dense)
    with monkeypatch.context() as patch:
        patch.setattr(np, "append", failing(number, np.append))
        with pytest.raises(MemoryError):
            pool.allocate(SLAB_PLACES, flags)
    assert pool.used == SLAB_PLACES
    for slot in pool.allocate(SLAB_PLACES, flags).tolist():
        assert pool.records(slot).ctypes.data == pool.address[slot]
        assert pool.dense[slot] == dense


@pytest.mark.parametrize("number", range(7))
def test_a_map_without_memory_for_its_tables_is_as_it_was(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    points = [[6.4 * x + 0.1, 0.1, 0.0] for x in range(40)]
    m, whole = (RoughMap(error_model="point", threads=1) for _ in range(2))
    for part in points[:20], points:
        whole.add(part)
        with monkeypatch.context() as patch:
            grown = failing(number, tiles.grown)
            patch.setattr(tiles, "grown", grown)
            patch.setattr(digest, "grown", grown)
            with pytest.raises(MemoryError):
                m.add(part)
        m.add(part)
    assert m.digest() == whole.digest()


@pytest.mark.parametrize("number", range(7))
def test_without_memory_no_tile_is_opened(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """One tile is known and has no column yet; with it come more new ones than the tables hold."""
    table = TileTable((1,) * 3, Shelf())
    tx, ty = np.arange(40, dtype=np.int32), np.zeros(40, np.int32)
    table.insert(tx[:1], ty[:1])
    entries, dense = np.where(tx == 0, 0, -1).astype(np.int32), tx % 2 == 0
    with monkeypatch.context() as patch:
        grown = failing(number, tiles.grown)
        patch.setattr(tiles, "grown", grown)
        patch.setattr(digest, "grown", grown)
        with pytest.raises(MemoryError):
            table.open(entries, tx, ty, dense, columns=True)
    assert (table.size, table.pool.nbytes, table.digests.outdated) == (1, SLOT_BYTES, {0})
    entries, taken = table.open(entries, tx, ty, dense, columns=True)
    assert entries.tolist() == tx.tolist()
    assert sorted(taken.tolist()) == sorted(table.slot[entries].tolist())
    assert table.pool.dense[table.slot[entries]].tolist() == [False, *dense[1:].tolist()]
    _, taken = table.open(entries, tx, ty, dense, columns=True)
    assert len(taken) == 0
