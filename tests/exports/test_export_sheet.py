"""Sheets: tiles and bands together cover the rectangle once, wherever the known tiles lie."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap.cell import TILE_CELLS
from roughmap_service.exports.cut import cells_of, tiles_in
from roughmap_service.exports.sheet import BAND_BYTES, Sheet

TILES = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=1, max_size=8, unique=True)


def plane(x: int, y: int) -> np.ndarray:
    """Each cell's own numbers, so that a cell in a wrong place shows."""
    j, i = np.mgrid[0:TILE_CELLS, 0:TILE_CELLS]
    return np.stack([x * TILE_CELLS + i, y * TILE_CELLS + j], axis=-1).astype(np.float32)


@given(TILES, st.tuples(*[st.integers(-200, 200)] * 2), st.tuples(*[st.integers(1, 250)] * 2), st.booleans())
def test_bands_are_the_rectangle(tiles: list, low: tuple[int, int], size: tuple[int, int], upward: bool) -> None:
    cells = (*low, low[0] + size[0], low[1] + size[1])
    chosen = tiles_in(np.array(tiles, np.int64), cells)
    sheet = Sheet(("mean_height", "count"), cells, 0.1, chosen, plane)
    bands = list(sheet.bands(upward=upward))
    assert max(len(band) for band in bands) <= TILE_CELLS
    whole = np.concatenate(bands)
    if not upward:
        whole = whole[::-1]
    assert whole.shape == (size[1], size[0], 2)
    j, i = np.mgrid[cells[1] : cells[3], cells[0] : cells[2]]
    known = np.isin((i // TILE_CELLS) * 100 + j // TILE_CELLS, [x * 100 + y for x, y in tiles])
    assert np.array_equal(whole[:, :, 0], np.where(known, i, np.nan).astype(np.float32), equal_nan=True)
    assert np.array_equal(whole[:, :, 1], np.where(known, j, 0).astype(np.float32))


@given(TILES)
def test_without_a_box_all_tiles_are_whole(tiles: list) -> None:
    known = np.array(tiles, np.int64)
    cells = cells_of(known, 0.1, None)
    assert len(tiles_in(known, cells)) == len(known)
    assert {value % TILE_CELLS for value in cells} == {0}


def test_one_layer_of_a_sheet_is_drawn_alone() -> None:
    sheet = Sheet(("mean_height", "count"), (0, 0, TILE_CELLS, TILE_CELLS), 0.1, np.zeros((1, 2), np.int64), plane)
    (part,) = sheet.only("count").parts()
    assert np.array_equal(part.values[:, :, 0], plane(0, 0)[:, :, 1])


@pytest.mark.parametrize("upward", [False, True])
def test_a_band_of_millions_of_columns_has_few_rows(upward: bool) -> None:
    far = 2**16
    cells = (0, 0, (far + 1) * TILE_CELLS, 2 * TILE_CELLS)
    sheet = Sheet(("mean_height", "count"), cells, 0.1, np.array([(0, 0), (far, 1)]), plane)
    ends = []
    for band in sheet.bands(upward=upward):
        assert band.nbytes <= BAND_BYTES
        ends.append(np.concatenate([band[:, :TILE_CELLS], band[:, -TILE_CELLS:]], axis=1))
    whole = np.concatenate(ends) if upward else np.concatenate(ends)[::-1]
    assert whole.shape == (2 * TILE_CELLS, 2 * TILE_CELLS, 2)
    assert np.array_equal(whole[:TILE_CELLS, :TILE_CELLS], plane(0, 0))
    assert np.array_equal(whole[TILE_CELLS:, TILE_CELLS:], plane(far, 1))
    assert np.isnan(whole[TILE_CELLS:, :TILE_CELLS, 0]).all()
    assert np.isnan(whole[:TILE_CELLS, TILE_CELLS:, 0]).all()
