"""What a call changes: tiles and their sequences at every level; frozen maps stay the same; limits on new tiles."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, SECOND_NS, cells_of, clouds, seeds, state_of

from roughmap import Noise, RoughMap, Scan, TooManyTiles, Trajectory
from roughmap.settings import SURFACES

S = np.eye(3) * 1e-4

RING = {"all": 1, "ground": 5}
"""Cells of 0.25 m and more around a tile that its layers depend on: a plane of 2, an overhang's window of 2, and 1."""


def held_by(m: RoughMap) -> dict[tuple[int, int], bytes]:
    """The known cells of a map with all that is kept of each, by (i, j)."""
    found = {}
    with m.freeze() as frozen:
        for x, y in frozen.tiles.tolist():
            state = frozen.state(x, y)
            assert state is not None
            for n in np.flatnonzero(state.cells["count"]).tolist():
                parts = [plane[n].tobytes() for plane in state if plane is not None]
                found[x * 64 + n % 64, y * 64 + n // 64] = b"".join(parts)
    return found


def sequences_of(m: RoughMap, level: int) -> dict[tuple[int, int], int]:
    with m.freeze(level) as frozen:
        return {(x, y): n for (x, y), n in zip(frozen.tiles.tolist(), frozen.sequences.tolist(), strict=True)}


@examples(60)
@given(
    seed=seeds,
    model=st.sampled_from(MODELS),
    surface=st.sampled_from(SURFACES),
    levels=st.sampled_from([1, 4, 26]),
    calls=st.integers(1, 6),
)
def test_sequences_are_those_of_the_last_change_in_the_tile_or_around_it(
    seed: int, model: str, surface: str, levels: int, calls: int
) -> None:
    """Compare all cells before and after each call, at every level, by brute force.

    The sequence of a tile is that of the last change in its cells and its ring. Points fall near tile borders of all
    levels and elsewhere.
    """
    ring = RING[surface]
    rng = np.random.default_rng(seed)
    a = 0.25
    m = RoughMap(cell_size=a, error_model=model, surface=surface, levels=levels, threads=1)
    expected: list[dict[tuple[int, int], int]] = [{} for _ in range(levels)]
    before: dict[tuple[int, int], bytes] = {}
    for _ in range(calls):
        number = int(rng.integers(1, 6))
        tile = rng.choice([-4, -2, -1, 0, 1, 2, 3, 4, 8], (number, 2)) * 64
        cells = tile + rng.choice([-9, -8, -6, -5, -2, -1, 0, 1, 4, 5, 7, 8, 31], (number, 2))
        points = np.column_stack([(cells + rng.uniform(0.0, 1.0, (number, 2))) * a, rng.normal(size=number)])
        report = m.add(points, S)
        now = held_by(m)
        changed = np.array([place for place, cell in now.items() if before.get(place) != cell])
        before = now
        assert {tuple(t) for t in report.tiles.tolist()} == {tuple(t) for t in (changed >> 6).tolist()}
        for level in range(levels):
            there = {tuple(place) for place in (np.array(list(now)) >> (6 + level)).tolist()}
            at_level = changed >> level
            for x, y in there:
                first = np.array([x, y]) * 64
                if ((at_level >= first - ring) & (at_level <= first + 63 + ring)).all(axis=1).any():
                    expected[level][x, y] = m.sequence
            assert sequences_of(m, level) == expected[level]


@examples(60)
@given(cloud=clouds(least=5), model=st.sampled_from(MODELS), level=st.integers(0, 3), cut=st.integers(1, 4))
def test_a_frozen_map_does_not_change(
    cloud: tuple[np.ndarray, np.ndarray, np.ndarray], model: str, level: int, cut: int
) -> None:
    """Bytes, sequences, stamps and layers of a frozen map, while all its cells change and tiles are added."""
    points, covariance, stamps = cloud
    m = RoughMap(error_model=model, threads=1)
    m.add(points[:cut], covariance[:cut], stamps[:cut])
    with m.freeze(level) as frozen:
        tiles = frozen.tiles.tolist()

        def seen() -> list[object]:
            names = ["mean_height", "slope", "traversability", "age"]
            return [
                frozen.tiles.tolist(),
                frozen.sequences.tolist(),
                frozen.sequence,
                [(frozen.stamps(x, y), frozen.digest(x, y), frozen.records(x, y).tobytes()) for x, y in tiles],
                [plane.tobytes() for x, y in tiles for plane in frozen.tile_layers(x, y, names).values()],
            ]

        before = seen()
        for _ in range(2):
            m.add(points, covariance, stamps + SECOND_NS)
            m.add(points + np.array([6.4, 0.1, 0.3]), covariance, stamps)
        assert seen() == before
        m.reset()
        m.add(points, covariance, stamps)
        assert seen() == before


def test_a_closed_frozen_map_leaves_no_memory_behind() -> None:
    """Copies made for frozen maps are freed: after any number of them the map takes the same memory."""
    m = RoughMap(error_model="point", threads=1)
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(5), [0.0]), axis=-1).reshape(-1, 3) * 6.4
    m.add(grid)
    before = m.memory_bytes
    for _ in range(20):
        with m.freeze():
            m.add(grid)
            assert m.memory_bytes > before
    assert m.memory_bytes == before


def by_add(m: RoughMap, points: np.ndarray, **options: int) -> object:
    return m.add(points, S, **options)


def by_scan(m: RoughMap, points: np.ndarray, **options: int) -> object:
    way = Trajectory([0], [(0, 0, 0)], [(0, 0, 0, 1)], np.zeros((1, 6, 6)))
    return m.add_scan(Scan(points, 0), way, Noise(0.01, beam_sigma=1e-3), **options)


@pytest.mark.parametrize("way_in", [by_add, by_scan])
def test_too_many_tiles_come_before_any_cell(way_in: Callable[..., object]) -> None:
    """Three tiles are known and four more are needed, one only by a footprint; known cells change as well."""
    m = RoughMap(error_model="cuboid", threads=1)
    known = np.array([(1.0, 1.0, 0.1), (7.0, 1.0, 0.1), (1.0, 7.0, 0.1)])
    m.add(known, S)
    # Tiles (0, 0), (-1, 0), (-1, -1), then (3, 0) and, over its border, (2, 0).
    more = np.array([(1.01, 1.0, 0.1), (-1.0, 1.0, 0.1), (-1.0, -1.0, 0.1), (19.201, 1.0, 0.1)])
    before = state_of(m)
    for options, limit in (({"max_new_tiles": 3}, 3), ({"max_tiles": 6}, 3), ({"max_new_tiles": 0}, 0)):
        with pytest.raises(TooManyTiles) as caught:
            way_in(m, more, **options)
        assert (caught.value.new, caught.value.limit) == (4, limit)
        assert state_of(m) == before
    with pytest.raises(TooManyTiles) as caught:
        way_in(m, more, max_tiles=2)
    assert caught.value.limit == 0
    assert state_of(m) == before
    free = RoughMap(error_model="cuboid", threads=1)
    free.add(known, S)
    way_in(free, more)
    way_in(m, more, max_new_tiles=4, max_tiles=7)
    assert state_of(m) == state_of(free)


def test_known_tiles_are_not_counted() -> None:
    m = RoughMap(error_model="point", threads=1)
    m.add([(1.0, 1.0, 1.0)])
    assert m.add([(2.0, 2.0, 1.0)], max_new_tiles=0, max_tiles=0).accepted == 1


def test_a_tile_without_a_share_is_not_made() -> None:
    """The footprint crosses a tile border by less than min_share: that tile is neither created nor counted."""
    m = RoughMap(error_model="cuboid", min_share=0.05, threads=1)
    # Half width 0.02, of which 0.0005 lies past 6.4: a share of 0.0125.
    report = m.add([(6.4 - 0.0195, 1.05, 1.0)], S, max_new_tiles=1)
    assert report.tiles.tolist() == [[0, 0]]
    assert m.tile_count == 1


def test_more_tiles_at_once_than_the_tables_first_hold() -> None:
    """3,000 tiles in one call: the tables double several times, and no tile is lost."""
    i, j = np.divmod(np.arange(3_000), 60)
    points = np.column_stack([(i - 25) * 6.4 + 0.05, (j - 30) * 6.4 + 0.05, np.arange(3_000.0)])
    m = RoughMap(error_model="point", threads=1)
    report = m.add(points)
    assert m.tile_count == 3_000
    np.testing.assert_array_equal(report.tiles, np.column_stack([i - 25, j - 30]))
    heights = {place: float(cell["mean"]) for place, cell in cells_of(m).items()}
    assert heights == {((x - 25) * 64, (y - 30) * 64): float(n) for n, (x, y) in enumerate(zip(i, j, strict=True))}
