"""Tiles that leave memory for a file and come back: the map, and what is read of it, are the same with and without."""

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from spill_tools import FAR, S, filled, ground, leave, leave_all, tiles_of

from roughmap import RoughMap
from roughmap.reading.layers import layers_of
from roughmap.tiles.state import TileState
from roughmap_service.store.spill import SLICE_BYTES, Spill

ALL = (-20.0, -20.0, 20.0, 20.0)


def read_all(rough_map: RoughMap, levels: Sequence[int] = (0, 1, 3)) -> list[bytes]:
    """Every layer over all of the ground, to the bit."""
    names = layers_of(rough_map.settings.surface)
    return [rough_map.region(ALL, names, level)[name].tobytes() for level in levels for name in names]


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


@examples(40)
@given(steps)
def test_a_map_that_spills_equals_one_that_does_not(todo: list[tuple[str, int, float]]) -> None:
    """Points, readings (some held over what follows), tiles that leave, and resets, in any order."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        spill = stack.enter_context(Spill(Path(folder) / "tiles", 1000 * SLICE_BYTES))
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
        assert (spill.used, spill.room) == (0, 1000), "no place is kept for nobody"


@pytest.mark.parametrize("number", [15, None])
def test_readers_see_tiles_that_left_over_borders_and_on_all_levels(spill: Spill, number: int | None) -> None:
    """Some of the neighbours in memory and some not, and all but one not."""
    plain, spilling = filled(), filled(spill)
    for m in (plain, spilling):
        m.add(ground(50, 300, 4.0), S, 10**9)
        m.add(FAR, S, 10**9)
    assert leave(spilling, number) == (number or plain.tile_count - 1)
    assert read_all(spilling) == read_all(plain)
    for level in range(4):
        assert tiles_of(spilling, level) == tiles_of(plain, level)
    resident = spilling.tile_count - spill.used
    assert spilling.resident_tiles == resident, "reading brings nothing back into memory"


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


def test_the_longest_unused_leave_first(spill: Spill, monkeypatch: pytest.MonkeyPatch) -> None:
    m = RoughMap(error_model="point", threads=1, shelf=spill)
    for x in (0.0, 10.0, 20.0, 30.0):
        m.add([[x, 0.0, 0.0]])
    m.add([[0.0, 0.0, 0.0]])  # again
    m.add([[40.0, 0.0, 0.0]])
    m.freeze(0, (1, 0, 1, 0)).close()  # the tile of x = 10 and its ring are asked for
    assert leave(m, 2) == 2
    asked, left, read = [0], [], spill.read

    def note(place: int, room: TileState) -> bool:
        left.append(asked[0])
        return read(place, room)

    monkeypatch.setattr(spill, "read", note)
    with m.freeze() as frozen:
        for x, y in frozen.tiles.tolist():
            asked[0] = x
            frozen.records(x, y)
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
    assert spilling.resident_tiles == len(changed[0])
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


def test_tiles_come_back_before_anybody_has_to_wait(spill: Spill, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock is taken for moments, never while a tile is read; the map is as it was until it changes."""
    plain, m = filled(), filled(spill)
    plain.add(FAR, S, 10**9)
    leave_all(m)
    lock, true, back = threading.Lock(), spill.read, list[int]()

    def read(place: int, room: TileState) -> bool:
        assert not lock.locked()
        back.append(place)
        return true(place, room)

    monkeypatch.setattr(spill, "read", read)
    prepared = m.prepare_points(ground(3), S, 10**9, reader_lock=lambda: lock)
    assert len(back) == m.resident_tiles - 1 > 20
    assert (m.digest(), m.sequence) == (plain.digest(), plain.sequence)
    with lock:
        report = m.integrate(prepared)
    assert report.tiles.tolist() == plain.add(ground(3), S, 10**9).tiles.tolist()
    monkeypatch.undo()
    assert tiles_of(m) == tiles_of(plain)


def test_what_was_prepared_is_not_done_when_its_tiles_have_left(spill: Spill) -> None:
    m = filled(spill)
    m.add(FAR, S, 10**9)
    prepared = m.prepare_points(ground(3), S, 10**9)
    assert leave(m)
    was = tiles_of(m)
    with pytest.raises(ValueError, match="in memory"):
        m.integrate(prepared)
    assert tiles_of(m) == was
