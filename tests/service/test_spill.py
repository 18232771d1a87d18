"""Tiles that leave memory for a file and come back: the map, and what is read of it, are the same with and without."""

import errno
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roughmap import RoughMap, TooManyTiles
from roughmap.layers import LAYERS
from roughmap.memory import SLOT_BYTES
from roughmap_service.memory import Memory, memory_bytes
from roughmap_service.spill import Spill, SpillError

S = np.diag([0.03, 0.03, 0.02]) ** 2
ALL = (-20.0, -20.0, 20.0, 20.0)
FAR = [[1001.0, 1.0, 0.0]]


@pytest.fixture
def spill(tmp_path: Path) -> Iterator[Spill]:
    with Spill(tmp_path / "tiles.spill", 1000 * SLOT_BYTES) as opened:
        yield opened


def ground(seed: int, number: int = 600, reach: float = 18.0) -> np.ndarray:
    """(number, 3) on a slope with bumps, over up to 6 x 6 tiles."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-reach, reach, (2, number))
    return np.column_stack([x, y, 0.1 * x + 0.2 * np.sin(y) + rng.normal(0, 0.02, number)])


def filled(spill: Spill | None = None) -> RoughMap:
    rough_map = RoughMap(levels=4, threads=1, shelf=spill)
    for seed in range(3):
        rough_map.add(ground(seed), S, (5 + seed) * 10**9)
    return rough_map


def leave(rough_map: RoughMap, number: int = 10**6) -> int:
    """Take tiles out of memory; how many left. What the last call wrote stays."""
    before = rough_map.resident_tiles
    eviction = rough_map.spill(number)
    try:
        eviction.write()
    finally:
        eviction.close()
    return before - rough_map.resident_tiles


def leave_all(rough_map: RoughMap) -> None:
    """All but one far tile, which the last call wrote."""
    rough_map.add(FAR, S, 10**9)
    leave(rough_map)
    assert rough_map.resident_tiles == 1


def read_all(rough_map: RoughMap, levels: Sequence[int] = (0, 1, 3)) -> list[bytes]:
    """Every layer over all of the ground, to the bit."""
    return [rough_map.region(ALL, list(LAYERS), level)[name].tobytes() for level in levels for name in LAYERS]


def tiles_of(rough_map: RoughMap, level: int = 0) -> dict[tuple[int, int], tuple[bytes, int, tuple[int, int]]]:
    """Records, sequences and stamps."""
    with rough_map.freeze(level) as frozen:
        return {
            (x, y): (frozen.records(x, y).tobytes(), int(sequence), frozen.stamps(x, y))
            for (x, y), sequence in zip(frozen.tiles.tolist(), frozen.sequences, strict=True)
        }


steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(0, 99), st.sampled_from([1.0, 7.0, 18.0])),
        st.tuples(st.just("leave"), st.integers(1, 40), st.none()),
        st.tuples(st.just("read"), st.integers(0, 3), st.none()),
        st.tuples(st.just("hold"), st.integers(0, 3), st.none()),
        st.tuples(st.just("let go"), st.none(), st.none()),
        st.tuples(st.just("reset"), st.none(), st.none()),
    ),
    min_size=3,
    max_size=25,
)


@settings(deadline=None, max_examples=40)
@given(steps)
def test_whatever_is_done_a_map_that_spills_is_the_map_that_does_not(todo: list[tuple[str, int, float]]) -> None:
    """Points, readings (some held over what follows), tiles that leave, and resets, in any order."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        spill = stack.enter_context(Spill(Path(folder) / "tiles", 1000 * SLOT_BYTES))
        with_spill, without = RoughMap(levels=4, threads=1, shelf=spill), RoughMap(levels=4, threads=1)
        held = []
        for what, number, reach in todo:
            if what == "leave":
                leave(with_spill, number)
                continue
            if what == "let go" and held:
                (here, there), tiles = held.pop(0)
                with here, there:
                    for (x, y), digest in tiles.items():
                        assert here.digest(x, y) == there.digest(x, y) == digest
                continue
            pair = with_spill, without
            if what == "add":
                reports = [m.add(ground(number, 50, reach), S, number * 10**9) for m in pair]
                assert reports[0].tiles.tolist() == reports[1].tiles.tolist()
            elif what == "read":
                assert tiles_of(with_spill, number) == tiles_of(without, number)
            elif what == "hold":
                frozen = tuple(m.freeze(number) for m in pair)
                held.append((frozen, {(x, y): frozen[1].digest(x, y) for x, y in frozen[1].tiles.tolist()}))
            elif what == "reset":
                for m in pair:
                    m.reset()
            assert with_spill.digest() == without.digest()
        for (here, there), _ in held:
            here.close()
            there.close()
        assert tiles_of(with_spill) == tiles_of(without)
        with_spill.reset()
        assert spill.used == 0, "no place is kept for nobody"


def test_readers_see_spilled_tiles_over_borders_and_on_all_levels(spill: Spill) -> None:
    plain, spilling = filled(), filled(spill)
    leave_all(spilling)
    plain.add(FAR, S, 10**9)
    assert read_all(spilling) == read_all(plain)
    for level in range(4):
        assert tiles_of(spilling, level) == tiles_of(plain, level)
    assert spilling.resident_tiles == 1, "reading brings nothing back into memory"


def test_some_neighbours_in_memory_and_some_not(spill: Spill) -> None:
    plain, spilling = filled(), filled(spill)
    for m in (plain, spilling):
        m.add(ground(50, 300, 4.0), S, 10**9)
    assert leave(spilling, 15) == 15
    assert read_all(spilling) == read_all(plain)


def test_a_reading_keeps_what_it_saw_however_tiles_come_and_go(spill: Spill) -> None:
    """Of its tiles some lie in the file, some in memory: all change, leave, come back changed, and leave again."""
    m = filled(spill)
    m.add(FAR, S, 10**9)
    assert leave(m, 18) == 18
    was = tiles_of(m)
    with m.freeze() as frozen:
        assert leave(m) == 0, "a tile that is read would free no memory"
        for seed in range(4):
            m.add(ground(60 + seed), S, 10**9)
            leave_all(m)
            for x, y in was:
                assert frozen.records(x, y).tobytes() == was[x, y][0]
    assert {tile: m for tile, (m, _, _) in tiles_of(m).items()} != {tile: m for tile, (m, _, _) in was.items()}
    m.reset()
    assert spill.used == 0


def test_a_checkpoint_reads_nothing_back(spill: Spill, monkeypatch: pytest.MonkeyPatch) -> None:
    m = filled(spill)
    leave_all(m)
    monkeypatch.setattr(spill, "read", lambda *_: pytest.fail("a tile was read"))
    plain = filled()
    plain.add(FAR, S, 10**9)
    assert m.digest() == plain.digest()


def test_the_longest_unused_leave_first(spill: Spill) -> None:
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    for x in (0.0, 10.0, 20.0, 30.0):
        m.add([[x, 0.0, 0.0]])
    m.add([[0.0, 0.0, 0.0]])  # again
    m.add([[40.0, 0.0, 0.0]])
    m.freeze(0, (1, 0, 1, 0)).close()  # the tile of x = 10 and its ring are asked for
    assert leave(m, 2) == 2
    with m.freeze() as frozen:
        assert frozen._slots is not None
        left = [x for (x, _), slot in zip(frozen.tiles.tolist(), frozen._slots.tolist(), strict=True) if slot < 0]
    assert left == [3, 4]


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_tile_that_changes_on_its_way_out_stays(spill: Spill, when: str) -> None:
    plain, spilling = filled(), filled(spill)
    for m in (plain, spilling):
        m.add(FAR, S, 10**9)
    eviction = spilling.spill(10**6)
    if when == "after":
        eviction.write()
    changed = [m.add(ground(70, 100, 5.0), S, 10**9).tiles for m in (plain, spilling)]
    if when == "before":
        eviction.write()
    eviction.close()
    assert spilling.resident_tiles == len(changed[0]) + 1
    assert tiles_of(spilling) == tiles_of(plain)
    assert spill.used == spilling.tile_count - spilling.resident_tiles


def test_a_reset_while_tiles_are_on_their_way_out(spill: Spill) -> None:
    m = filled(spill)
    m.add(FAR, S, 10**9)
    eviction = m.spill(10**6)
    m.reset()
    eviction.write()
    eviction.close()
    assert (spill.used, m.tile_count, m.digest()) == (0, 0, RoughMap().digest())


def test_an_emptied_map_gives_its_places_back(spill: Spill) -> None:
    m = filled(spill)
    leave_all(m)
    assert spill.used == m.tile_count - 1
    room = spill.room
    with m.freeze(1) as frozen:
        was = [frozen.digest(x, y) for x, y in frozen.tiles.tolist()]
        m.reset()
        assert m.digest() == RoughMap().digest()
        assert spill.used
        m.add(ground(1), S, 10**9)
        leave_all(m)
        assert [frozen.digest(x, y) for x, y in frozen.tiles.tolist()] == was
    m.reset()
    assert spill.used == 0
    assert spill.room > room


def test_the_file_grows_no_further_than_tiles_are_spilled_at_once(spill: Spill) -> None:
    m = filled(spill)
    sizes = []
    for _ in range(4):
        leave_all(m)
        m.add(ground(0), S, 10**9)
        sizes.append(spill.path.stat().st_size)
    assert sizes[1:] == sizes[:1] * 3


class Disk:
    """A disk that is full when it is told so."""

    def __init__(self) -> None:
        self.left = 10**9

    def write(self, file: int, parts: Sequence[memoryview], offset: int) -> int:
        if self.left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.left -= 1
        return os.pwritev(file, parts, offset)


@pytest.mark.parametrize("left", [0, 1, 20])
def test_a_full_disk_loses_no_tile(tmp_path: Path, left: int) -> None:
    disk = Disk()
    with Spill(tmp_path / "tiles", 1000 * SLOT_BYTES, write=disk.write) as spill:
        m = filled(spill)
        m.add(FAR, S, 10**9)
        was, tiles = m.digest(), tiles_of(m)
        disk.left = left
        with pytest.raises(OSError, match="space"):
            leave(m)
        assert (m.digest(), m.tile_count - m.resident_tiles, spill.used) == (was, left, left)
        assert tiles_of(m) == tiles
        disk.left = 10**9
        leave(m)
        assert (m.resident_tiles, m.digest()) == (1, was)
        assert tiles_of(m) == tiles


def test_a_short_write_is_a_full_disk(tmp_path: Path) -> None:
    with Spill(tmp_path / "tiles", 10 * SLOT_BYTES, write=lambda *_: 100) as spill:
        m = filled(spill)
        m.add(FAR, S, 10**9)
        with pytest.raises(OSError, match="space"):
            leave(m)
        assert spill.used == 0


def pressed(spill: Spill, m: RoughMap) -> tuple[Memory, Callable[[], None]]:
    """Memory that counts tiles alone, 32 of them allowed, and a way to relieve it."""
    memory = Memory(32 * SLOT_BYTES, spill, measure=lambda: m.resident_tiles * SLOT_BYTES)
    memory._before = 0
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
    """Tiles full of points, which lie in huge pages where there are some: 200 of 256 KiB, less what else moves."""
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    cells = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1).reshape(-1, 2) * 0.1 + 0.05
    for n in range(201):
        m.add(np.column_stack([cells + np.array([6.4 * n, 0.0]), np.zeros(len(cells))]))
    before = memory_bytes()
    assert leave(m) == 200
    assert before - memory_bytes() > 180 * SLOT_BYTES


def test_where_tiles_cannot_leave_the_memory_says_full_until_they_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = Disk()
    disk.left = 0
    monkeypatch.setattr("roughmap_service.memory.RETRY_SECONDS", 0.0)
    with Spill(tmp_path / "tiles", 1000 * SLOT_BYTES, write=disk.write) as spill:
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
    memory, relieve = pressed(spill, m)
    memory._measure = lambda: m._table.pool.used * SLOT_BYTES
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
    with Spill(tmp_path / "tiles", 10 * SLOT_BYTES) as spill:
        m = RoughMap(error_model="point", threads=1, shelf=spill)
        memory, relieve = pressed(spill, m)
        for x in range(60):
            m.add([[6.4 * x + 0.1, 0.0, 0.0]])
            relieve()
        assert (memory.ok, memory.full, m.resident_tiles) == (False, True, 50)
        assert spill.path.stat().st_size <= 10 * SLOT_BYTES


def test_what_is_not_as_it_was_written_is_found(spill: Spill) -> None:
    """A flipped bit, by a reader and by the writer; the map stays as it was."""
    m = filled(spill)
    leave_all(m)
    was = m.digest()
    with spill.path.open("r+b") as file:
        file.seek(1000)
        byte = file.read(1)
        file.seek(1000)
        file.write(bytes([byte[0] ^ 1]))
    with pytest.raises(SpillError, match="not as it was written"):
        tiles_of(m)
    assert "tiles.spill" in spill.failure
    sequence = m.sequence
    with pytest.raises(SpillError, match="not as it was written"):
        m.add(ground(3, 5000), S, 10**9)
    assert (m.digest(), m.sequence, m.resident_tiles) == (was, sequence, 1)


@pytest.mark.parametrize("number", range(5))
def test_places_for_which_there_is_no_memory(spill: Spill, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    calls, true = iter(range(100)), np.append

    def append(*args: Any) -> Any:
        if next(calls) == number:
            raise MemoryError
        return true(*args)

    m = filled(spill)
    was = tiles_of(m)
    m.add(FAR, S, 10**9)  # all else may leave
    with monkeypatch.context() as patch:
        patch.setattr(np, "append", append)
        with pytest.raises(MemoryError):
            leave(m)
    assert spill.used == 0
    leave_all(m)
    assert m.resident_tiles == 1
    assert {tile: tiles_of(m)[tile] for tile in was} == was


def test_the_file_is_emptied_at_the_start_and_removed_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "tiles"
    with Spill(path, 10 * SLOT_BYTES), pytest.raises(SpillError, match="another service"):
        Spill(path, 10 * SLOT_BYTES)
    assert not path.exists()
    path.write_bytes(b"left over" * 100)
    path.chmod(0o644)
    with Spill(path, 10 * SLOT_BYTES):
        assert path.stat().st_size == 0
        assert path.stat().st_mode & 0o777 == 0o644, "as it was made"
    with pytest.raises(SpillError, match="spill_path"):
        Spill(tmp_path, 10 * SLOT_BYTES)
    with pytest.raises(SpillError, match="no plain file"):
        Spill(Path("/dev/null"), 10 * SLOT_BYTES)
    assert Path("/dev/null").exists()
