"""Which tiles count as changed, for rings of any width; by brute force over the cells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap.tiles.changes import rings
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.table import TileTable

LEVELS = 4
CENTRE = 2**20


@examples(60)
@given(
    widths=st.tuples(*[st.integers(1, 63)] * LEVELS),
    tile=st.tuples(st.integers(-9, 8), st.integers(-9, 8)),
    offsets=st.lists(st.tuples(st.integers(0, 63), st.integers(0, 63)), min_size=1, max_size=3),
    corner=st.sampled_from([0, CENTRE, -CENTRE]),
)
def test_a_tile_counts_if_a_changed_cell_is_in_it_or_in_its_ring(
    widths: tuple[int, ...], tile: tuple[int, int], offsets: list[tuple[int, int]], corner: int
) -> None:
    """Changes in one tile of level 0, in a field of 36 x 36 of them."""
    table = TileTable(widths, Shelf())
    x, y = (numbers.astype(np.int32) + corner for numbers in np.divmod(np.arange(36 * 36), 36))
    table.insert(x - 18, y - 18)
    tx, ty = tile[0] + corner, tile[1] + corner
    bits = np.zeros((1, 64), np.uint64)
    for i, j in offsets:
        bits[0, j] |= np.uint64(1) << np.uint64(i)
    entry = np.array([table.levels[0].find(tx, ty)], np.int32)
    table.mark_changed(entry, np.array([tx], np.int32), np.array([ty], np.int32), bits, 7)
    cells = np.array(offsets) + 64 * np.array([tx, ty])
    for level, (index, width) in enumerate(zip(table.levels, widths, strict=True)):
        x, y, sequence = index.select()
        low, high = np.stack([x, y], axis=1) * 64 - width, np.stack([x, y], axis=1) * 64 + 63 + width
        inside = ((cells >> level >= low[:, None]) & (cells >> level <= high[:, None])).all(axis=2).any(axis=1)
        np.testing.assert_array_equal(sequence == 7, inside)
    assert table.digests.outdated == set(range(table.size))


@pytest.mark.parametrize(
    ("cell_size", "expected"),
    [
        # 0.3 m and 0.5 m are 3 and 5 cells of 0.1 m, 2 (1.5, to even) and 2 of 0.2 m; then 1.5 and 2 cells.
        (0.1, (9, 5, 5, 5)),
        (0.25, (5, 5, 5, 5)),
        (0.04, (17, 11, 6, 5)),  # 7.5 and 12.5 cells, at most 6 and 10; 4 (3.75) and 6; 2 (1.875) and 3 (3.125)
        (0.01, (17, 17, 17, 11)),
        (1.0, (5, 5, 5, 5)),
    ],
)
def test_rings_of_the_ground(cell_size: float, expected: tuple[int, ...]) -> None:
    assert rings("ground", cell_size, 4) == expected


def test_rings_of_all_points() -> None:
    assert rings("all", 0.01, 3) == (1, 1, 1)
