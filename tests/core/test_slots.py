"""Slots and their columns: zeroed, copied, pinned and given back as one."""

from typing import Any

import numpy as np
import pytest

from roughmap.cell import BASED
from roughmap.tiles.columns import COLUMN_BYTES, KEPT_COLUMNS
from roughmap.tiles.slabs import SLAB_PLACES
from roughmap.tiles.slots import SLOT_BYTES, TRUST_OFFSET, SlotPool
from roughmap_service.store.memory_limit import memory_bytes


def write(pool: SlotPool, slot: int, cells: np.ndarray, *, column: bool = True) -> None:
    """Fill some cells of a slot, and of its column."""
    state = pool.writable(slot)
    state.cells["count"][cells], state.cells["mean"][cells], state.trust["stamp_ms"][cells] = 1, cells, cells + 1
    if column:
        assert state.column is not None
        state.column["flags"][cells], state.column["bins"][cells, 39] = BASED, cells % 251


def content(pool: SlotPool, slot: int) -> list[bytes]:
    return [array.tobytes() for array in pool.state(slot).arrays]


def only(*slots: int) -> np.ndarray:
    return np.array(slots, np.int32)


@pytest.mark.parametrize("dense", [False, True])
def test_where_cells_trust_and_column_are(dense: bool) -> None:
    pool = SlotPool()
    slots = pool.allocate(3, np.full(3, dense))
    pool.take_columns(slots[1:])
    for slot in slots.tolist():
        state = pool.writable(slot)
        assert state.cells.ctypes.data == pool.address[slot]
        assert state.trust.ctypes.data == pool.address[slot] + TRUST_OFFSET
        assert all(array.shape == (4096,) for array in state.arrays)
        if state.column is None:
            assert (slot, pool.column_address[slot]) == (slots[0], 0)
        else:
            assert state.column.ctypes.data == pool.column_address[slot]
            assert pool.column_address[slot] % 64 == 0
    assert SLOT_BYTES == TRUST_OFFSET + 4096 * 20
    assert pool.nbytes == 3 * SLOT_BYTES + 2 * COLUMN_BYTES


def test_a_slot_takes_one_column() -> None:
    pool = SlotPool()
    slots = pool.allocate(4)
    assert pool.take_columns(slots[:2]).tolist() == slots[:2].tolist()
    before = pool.column_address[slots[:2]].copy()
    assert pool.take_columns(slots).tolist() == slots[2:].tolist()
    assert pool.column_address[slots[:2]].tolist() == before.tolist()
    assert len(set(pool.column_address[slots].tolist())) == 4
    pool.drop_columns(slots[1:3])
    assert (pool.column_address[slots] != 0).tolist() == [True, False, False, True]
    pool.drop_columns(slots[1:2])
    assert pool.take_columns(slots).tolist() == slots[1:3].tolist()


@pytest.mark.parametrize("dense", [False, True])
def test_what_is_handed_out_again_is_zero(dense: bool) -> None:
    pool, cells = SlotPool(), np.arange(0, 4096, 7)
    seen = set()
    for _ in range(3):
        slots = pool.allocate(5, np.full(5, dense))
        seen.update(slots.tolist())
        pool.take_columns(slots)
        for slot in slots.tolist():
            assert not any(any(part) for part in content(pool, slot))
            write(pool, slot, cells)
        pool.release(slots)
    assert len(seen) == 5
    assert pool.nbytes == 0
    assert not pool.column_address.any()


@pytest.mark.parametrize("rows", [range(64), range(3, 60, 9)])
def test_a_copy_has_a_column_of_its_own(rows: range) -> None:
    pool = SlotPool()
    cells = np.concatenate([np.arange(64 * j, 64 * j + 64, 5) for j in rows])
    both, plain = pool.allocate(2).tolist()
    pool.take_columns(only(both))
    write(pool, both, cells)
    write(pool, plain, cells, column=False)
    was = content(pool, both), content(pool, plain)
    copies = pool.duplicate(only(both, plain)).tolist()
    assert (content(pool, copies[0]), content(pool, copies[1])) == was
    assert pool.dense[copies].tolist() == [len(rows) == 64] * 2
    write(pool, copies[0], np.arange(9))
    assert (content(pool, both), content(pool, plain)) == was
    assert content(pool, copies[0]) != was[0]


def test_a_copy_has_nothing_of_a_column_that_was_there_before() -> None:
    """The memory of a freed column is kept for the next copy."""
    pool = SlotPool()
    first, second = pool.allocate(2).tolist()
    pool.take_columns(only(first, second))
    write(pool, first, np.arange(0, 4096, 3))
    write(pool, second, np.arange(640, 1000, 7))
    for source in (first, second, first):
        copy = pool.duplicate(only(source))
        assert content(pool, int(copy[0])) == content(pool, source)
        pool.release(copy)
    fresh = pool.allocate(3)
    pool.take_columns(fresh)
    assert not any(any(content(pool, slot)[2]) for slot in fresh.tolist())


def test_a_pinned_slot_keeps_its_column_until_it_is_unpinned() -> None:
    pool, cells = SlotPool(), np.arange(100, 200)
    slot = only(pool.allocate(1)[0])
    pool.take_columns(slot)
    write(pool, int(slot[0]), cells)
    was = content(pool, int(slot[0]))
    pool.pin(slot)
    pool.release(slot)
    others = pool.allocate(SLAB_PLACES)
    pool.take_columns(others)
    assert content(pool, int(slot[0])) == was
    assert pool.nbytes == (SLAB_PLACES + 1) * (SLOT_BYTES + COLUMN_BYTES)
    pool.unpin(slot)
    assert pool.nbytes == SLAB_PLACES * (SLOT_BYTES + COLUMN_BYTES)
    assert pool.column_address[slot[0]] == 0


def test_columns_cost_the_rows_that_are_written_and_nothing_once_released() -> None:
    """200 slots with a column each of which one row is based; then all of it; then none."""
    pool = SlotPool()
    slots = pool.allocate(200)
    empty = memory_bytes()
    pool.take_columns(slots)
    for slot in slots.tolist():
        pool.state(slot)
    assert memory_bytes() - empty < 4 << 20, "columns nobody has written to"
    for slot in slots.tolist():
        write(pool, slot, np.arange(640, 704))
    # A page of cells, up to two of trust, and a page of the column.
    assert memory_bytes() - empty < 200 * 4 * 4096 + (4 << 20)
    for slot in slots.tolist():
        write(pool, slot, np.arange(4096))
    full = memory_bytes()
    assert full - empty > 190 * (SLOT_BYTES + COLUMN_BYTES)
    pool.release(slots)
    assert full - memory_bytes() > 190 * SLOT_BYTES + (190 - KEPT_COLUMNS) * COLUMN_BYTES
    pool.trim()
    assert full - memory_bytes() > 190 * (SLOT_BYTES + COLUMN_BYTES)


def test_columns_dropped_unwritten_leave_no_memory_behind() -> None:
    pool = SlotPool()
    slots = pool.allocate(100)
    before = memory_bytes()
    for _ in range(200):
        pool.drop_columns(pool.take_columns(slots))
    assert memory_bytes() - before < 4 << 20


@pytest.mark.parametrize(("act", "number"), [("take_columns", 0), *(("duplicate", n) for n in range(7))])
def test_without_memory_for_columns_nothing_changes(monkeypatch: pytest.MonkeyPatch, act: str, number: int) -> None:
    """A slab is full, and memory is short at one step or the other of getting another."""
    pool = SlotPool()
    slots = pool.allocate(SLAB_PLACES)
    pool.take_columns(slots[:-1])
    for slot in slots[:-1].tolist():
        write(pool, slot, np.arange(3))
    was = [content(pool, slot) for slot in slots.tolist()]
    every = np.concatenate([slots, pool.allocate(1)]) if act == "take_columns" else slots
    used, calls, true = pool.used, iter(range(100)), np.append

    def append(*args: Any) -> Any:
        if next(calls) == number:
            raise MemoryError
        return true(*args)

    with monkeypatch.context() as patch:
        patch.setattr(np, "append", append)
        with pytest.raises(MemoryError):
            getattr(pool, act)(every)
    assert [content(pool, slot) for slot in slots.tolist()] == was
    assert (pool.used, pool.nbytes) == (used, used * SLOT_BYTES + (SLAB_PLACES - 1) * COLUMN_BYTES)
    pool.take_columns(every)
    copies = pool.duplicate(slots)
    assert [content(pool, slot)[:2] for slot in copies.tolist()] == [parts[:2] for parts in was]
    for slot in [*every.tolist(), *copies.tolist()]:
        column = pool.writable(slot).column
        assert column is not None
        assert column.ctypes.data == pool.column_address[slot]
