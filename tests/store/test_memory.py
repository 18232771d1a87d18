"""The process's memory, held to its limit by tiles that leave it."""

import itertools
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from disks import SpillDisk
from spill_tools import leave

from roughmap import RoughMap, TooManyTiles
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_service.store.memory_limit import MemoryLimit, memory_bytes
from roughmap_service.store.spill import SLICE_BYTES, Spill


def pressed(spill: Spill, m: RoughMap) -> tuple[MemoryLimit, Callable[[], None]]:
    """Memory that counts tiles alone, 32 of them allowed, and a way to relieve it; the map is still empty."""
    memory = MemoryLimit(32 * SLOT_BYTES, spill, measure=lambda: m.resident_tiles * SLOT_BYTES)
    return memory, lambda: memory.relieve(lambda: nullcontext(m))


def test_memory_is_relieved_down_to_the_low_mark_and_then_left_alone(spill: Spill) -> None:
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    memory, relieve = pressed(spill, m)
    seen = []
    for x in range(100):
        m.add([[6.4 * x + 0.1, 0.0, 0.0]])
        relieve()
        seen.append(m.resident_tiles)
    assert max(seen) <= 32
    assert min(seen[40:]) == 28
    assert 10 < sum(a > b for a, b in itertools.pairwise(seen)) < 30, "in batches, not one by one"
    assert memory.ok
    assert not memory.full


def test_what_leaves_memory_is_given_back_to_the_system(spill: Spill) -> None:
    """Tiles full of points, which lie in huge pages where there are some: 200 of 336 KiB, less what else moves."""
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    cells = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1).reshape(-1, 2) * 0.1 + 0.05
    for n in range(201):
        m.add(np.column_stack([cells + np.array([6.4 * n, 0.0]), np.zeros(len(cells))]))
    before = memory_bytes()
    assert leave(m, 200) == 200
    assert before - memory_bytes() > 180 * SLOT_BYTES


def test_a_scan_of_more_tiles_than_the_limit_does_not_stay(spill: Spill) -> None:
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    memory, relieve = pressed(spill, m)
    m.add([[6.4 * x + 0.1, 0.0, 0.0] for x in range(100)])
    relieve()
    assert (m.resident_tiles, m.tile_count, memory.full) == (28, 100, False)


def test_where_tiles_cannot_leave_the_memory_says_full_until_they_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = SpillDisk()
    disk.left = 0
    monkeypatch.setattr("roughmap_service.store.memory_limit.RETRY_SECONDS", 0.0)
    with Spill(tmp_path / "tiles", 1000 * SLICE_BYTES, write=disk.write) as spill:
        m = RoughMap(error_model="point", threads=1, shelf=spill)
        memory, relieve = pressed(spill, m)
        for x in range(40):
            relieve()
            assert memory.full == (m.resident_tiles > 32)
            try:
                m.add([[6.4 * x + 0.1, 0.0, 0.0]], max_new_tiles=0 if memory.full else None)
            except TooManyTiles:
                assert memory.full
        assert m.resident_tiles == 33
        assert m.add([[0.1, 0.0, 0.0]], max_new_tiles=0).accepted == 1, "known ground goes on"
        assert len([r for r in caplog.records if "can't leave memory" in r.message]) == 1
        disk.left = 10**9
        relieve()
        assert (memory.ok, memory.full, m.resident_tiles) == (True, False, 28)


def test_while_readers_hold_all_tiles_what_comes_leaves(spill: Spill) -> None:
    """Beyond what they hold, memory has the tiles of one scan: it refuses nothing, and needs no bound of its own."""
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    memory = MemoryLimit(32 * SLOT_BYTES, spill, measure=lambda: m._table.pool.used * SLOT_BYTES)
    relieve = partial(memory.relieve, lambda: nullcontext(m))
    m.add([[6.4 * x + 0.1, 0.0, 0.0] for x in range(30)])
    with m.freeze():
        for n in range(20):
            m.add([[6.4 * (n + x) + 0.1, 0.0, float(n)] for x in range(15)])
            relieve()
            assert (memory.ok, memory.full) == (True, False)
            assert m._table.pool.used <= 30 + 15
    relieve()
    assert m._table.pool.used <= 28


def test_a_file_that_may_not_grow_is_a_full_one(tmp_path: Path) -> None:
    with Spill(tmp_path / "tiles", 10 * SLICE_BYTES) as spill:
        m = RoughMap(error_model="point", threads=1, shelf=spill)
        memory, relieve = pressed(spill, m)
        for x in range(60):
            m.add([[6.4 * x + 0.1, 0.0, 0.0]])
            relieve()
        assert (memory.ok, memory.full, m.resident_tiles) == (False, True, 50)
        assert spill.path.stat().st_size <= 10 * SLICE_BYTES


def test_no_memory_to_choose_what_leaves_is_no_end(spill: Spill, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shelf's tables grow with what lies there."""
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    memory, relieve = pressed(spill, m)
    m.add([[6.4 * x + 0.1, 0.0, 0.0] for x in range(40)])

    def no_memory() -> None:
        raise MemoryError

    monkeypatch.setattr("roughmap_service.store.memory_limit.RETRY_SECONDS", 0.0)
    with monkeypatch.context() as short:
        short.setattr(spill, "_grow", no_memory)
        relieve()
        assert (memory.ok, memory.full, m.resident_tiles) == (False, True, 40)
    relieve()
    assert (memory.ok, memory.full, m.resident_tiles) == (True, False, 28)
