"""Tiles that are forgotten: what stays is as if they had never been, and what was next to them counts as changed."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import cells_of, seeds, state_of

from roughmap import RoughMap
from roughmap.reading.layers import layers_of

LEVELS = 4
EVERYWHERE = (-200.0, -200.0, 200.0, 200.0)
"""What `read_from` reads: 6 x 6 tiles and a margin."""

SECOND = 10**9


def scan(rng: np.random.Generator, number: int = 40, reach: int = 6) -> np.ndarray:
    """Points over up to twice ``reach`` tiles of 64 m each way, many near borders."""
    tiles = rng.integers(-reach, reach, (number, 2)) * 64.0
    return np.column_stack([tiles + rng.choice([0.5, 1.5, 31.5, 63.5], (number, 2)), rng.normal(size=number)])


def in_tiles(points: np.ndarray, gone: set[tuple[int, int]]) -> np.ndarray:
    return np.array([(int(x // 64), int(y // 64)) in gone for x, y, _ in points])


def read_from(m: RoughMap) -> list[Any]:
    """Everything read at each level, without sequences and ages."""
    names = [name for name in layers_of(m.settings.surface) if name != "age"]
    found: list[Any] = [cells_of(m)]
    for level in range(LEVELS):
        region = m.region(EVERYWHERE, names, level)
        found += [region[name].tobytes() for name in names]
    return found


@examples(25)
@given(seed=seeds, rounds=st.integers(1, 3), read=st.booleans())
def test_what_stays_is_a_map_of_the_other_points(seed: int, rounds: int, read: bool) -> None:
    """Points come, tiles go, points come again, some to where tiles were; levels are read in between or not."""
    rng = np.random.default_rng(seed)
    m = RoughMap(cell_size=1.0, error_model="point", levels=LEVELS, threads=1)
    left = np.zeros((0, 4))
    for number in range(1, rounds + 1):
        points = scan(rng, 12, 3)
        m.add(points, stamp_ns=number * SECOND)
        left = np.concatenate([left, np.column_stack([points, np.full(len(points), number)])])
        if read:
            read_from(m)
        wanted = rng.integers(-4, 4, (int(rng.integers(1, 30)), 2))
        there = {tuple(tile) for tile in m.tile_sequences()[0].tolist()}
        gone = {tuple(tile) for tile in wanted.tolist()} & there
        sequence = m.sequence
        assert m.forget(np.concatenate([wanted, wanted[:2], [(2**31 - 1, 0), (2**25, 0)]])) == len(gone)
        assert m.sequence == sequence + bool(gone)
        left = left[~in_tiles(left[:, :3], gone)]
    other = RoughMap(cell_size=1.0, error_model="point", levels=LEVELS, threads=1)
    if len(left):
        other.add(left[:, :3], stamp_ns=left[:, 3].astype(np.int64) * SECOND)
    assert (m.digest(), m.tile_count, m.extent()) == (other.digest(), other.tile_count, other.extent())
    assert m.newest_updated == other.newest_updated
    assert read_from(m) == read_from(other)
    for level in range(LEVELS):
        assert m.tile_sequences(level)[0].tolist() == other.tile_sequences(level)[0].tolist()


@examples(40)
@given(seed=seeds)
def test_all_that_is_derived_from_a_forgotten_tile_gets_a_new_sequence(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = RoughMap(cell_size=1.0, error_model="point", levels=LEVELS, threads=1)
    m.add(scan(rng, 90))
    was = [m.tile_sequences(level)[0].tolist() for level in range(LEVELS)]
    gone = was[0][:: int(rng.integers(1, 30))]
    m.forget(gone)
    for level in range(LEVELS):
        tiles, sequences = m.tile_sequences(level)
        # Whole tiles count as changed: at a level, the cells under them.
        low = (np.array(gone) * 64) >> level
        high = (np.array(gone) * 64 + 63) >> level
        for (x, y), sequence in zip(tiles.tolist(), sequences.tolist(), strict=True):
            corner = np.array([x, y]) * 64
            near = ((high >= corner - 1) & (low <= corner + 64)).all(axis=1).any()
            assert sequence == (2 if near else 1), (level, x, y)
        assert m.changed_tiles(level, 1)[0].tolist() == tiles[sequences == 2].tolist()


@examples(30)
@given(seed=seeds, level=st.integers(0, LEVELS - 1))
def test_who_holds_a_frozen_map_keeps_the_tiles(seed: int, level: int) -> None:
    rng = np.random.default_rng(seed)
    m = RoughMap(cell_size=1.0, error_model="point", levels=LEVELS, threads=1)
    m.add(scan(rng))
    versions = m.tile_versions()
    with m.freeze(level) as frozen:

        def seen() -> list[Any]:
            tiles = frozen.tiles.tolist()
            held = [(frozen.stamps(x, y), frozen.digest(x, y), frozen.records(x, y).tobytes()) for x, y in tiles]
            layers = [frozen.tile_layers(x, y, ["slope", "traversability"])["slope"].tobytes() for x, y in tiles]
            return [tiles, frozen.sequences.tolist(), held, layers, [v.select()[0].tolist() for v in versions]]

        was = seen()
        for _ in range(3):
            m.forget(rng.integers(-6, 6, (30, 2)))
            m.add(scan(rng))
            assert seen() == was
        m.forget(m.tile_sequences()[0])
        assert (m.tile_count, m.extent(), m.newest_updated) == (0, None, 0)
        assert seen() == was
    assert m._table.pool.used == 0


def test_points_prepared_before_tiles_were_forgotten() -> None:
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    m.add([(0.5, 0.5, 1.0), (640.5, 0.5, 1.0)])
    prepared = m.prepare_points([(640.5, 0.5, 1.1)])
    assert m.forget([(5, 5)]) == 0
    m.integrate(prepared)
    prepared = m.prepare_points([(640.5, 0.5, 1.1)])
    assert m.forget([(0, 0)]) == 1
    with pytest.raises(ValueError, match="prepared last"):
        m.integrate(prepared)
    m.add([(640.5, 0.5, 1.2)])
    assert {place: int(cell["count"]) for place, cell in cells_of(m).items()} == {(640, 0): 3}


@pytest.mark.parametrize("tiles", [[1, 2], [[1, 2, 3]], [[0.0, 0.0]], "all", [[True, False]], [[None, 0]]])
def test_what_is_no_list_of_tiles(tiles: Any) -> None:
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    m.add([(0.5, 0.5, 1.0)])
    before = state_of(m)
    with pytest.raises(ValueError, match=r"tiles: expected \(T, 2\) integers"):
        m.forget(tiles)
    assert state_of(m) == before


def test_nothing_to_forget() -> None:
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    m.add([(0.5, 0.5, 1.0)])
    before = state_of(m)
    assert m.forget([]) == m.forget(np.zeros((0, 2), np.int32)) == m.forget([(3, 3)]) == 0
    assert state_of(m) == before
    assert m.forgotten_at == 0
    m.forget([(0, 0)])
    assert (m.forgotten_at, m.sequence) == (2, 2)
