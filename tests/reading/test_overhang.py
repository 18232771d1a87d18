"""What counts as an object over the ground: heights at the limits, hits around a bin, columns that begin elsewhere."""

import numpy as np
import pytest

from roughmap.cell import BASED, COLUMN_DTYPE, TILE_CELLS
from roughmap.reading.halo import NO_COLUMN
from roughmap.reading.overhang import Overhang, overhang

FLAT = np.zeros((TILE_CELLS, TILE_CELLS))


def columns(tiles: dict[int, dict[tuple[int, int], tuple[int, dict[int, int]]]]) -> tuple[np.ndarray, ...]:
    """Return the bytes of nine tiles from {tile: {(i, j): (base, {bin: hits})}}; the fifth, number 4, is the tile."""
    made = []
    for place in range(9):
        column = np.zeros((TILE_CELLS, TILE_CELLS), COLUMN_DTYPE)
        for (i, j), (base, bins) in tiles.get(place, {}).items():
            column[j, i]["flags"], column[j, i]["base"] = BASED, base
            for k, hits in bins.items():
                column[j, i]["bins"][k // 2] |= hits << 4 * (k % 2)
        flat = column.view(np.uint8).reshape(TILE_CELLS * TILE_CELLS, -1)
        flat.flags.writeable = False
        made.append(flat if place in tiles else NO_COLUMN)
    return tuple(made)


def look(tiles: dict, ground: np.ndarray = FLAT, gx: np.ndarray = FLAT) -> Overhang:
    return overhang(columns(tiles), ground, gx, FLAT, 0.1, 0.2, 2.0)


@pytest.mark.parametrize(("gradient", "lowest"), [(0.0, 0.2), (0.5, 0.235), (np.nan, 0.2)])
def test_up_to_the_step_and_what_a_slope_adds_it_is_ground(gradient: float, lowest: float) -> None:
    """Bin 30 of base 0 has its centre at 1.525 m."""
    for over, found in ((lowest + 1e-6, 1.0), (lowest - 1e-6, 0.0)):
        got = look({4: {(5, 5): (0, {30: 3})}}, FLAT + 1.525 - over, FLAT + gradient)
        assert got.obstacle[5, 5] == found
        assert got.obstacle.sum() == found


def test_below_the_clearance_it_blocks_from_there_on_it_hangs() -> None:
    for over, blocks in ((2.0 - 1e-6, True), (2.0 + 1e-6, False)):
        got = look({4: {(5, 5): (0, {50: 3})}}, FLAT + 2.525 - over)
        assert got.obstacle[5, 5] == blocks
        assert np.isfinite(got.obstacle_top[5, 5]) == blocks
        assert np.isfinite(got.overhang_low[5, 5]) == (not blocks)


def test_the_highest_that_blocks_and_the_lowest_that_hangs() -> None:
    got = look({4: {(0, 63): (-11, {30: 4, 40: 15, 44: 2, 70: 3, 76: 9})}}, FLAT)
    assert got.obstacle_top[63, 0] == pytest.approx(0.925)  # bin 40: (-22 + 40.5) 0.05
    assert got.overhang_low[63, 0] == pytest.approx(2.425)
    assert np.isnan(np.delete(got.obstacle_top.ravel(), 63 * 64)).all()


def test_hits_around_a_bin_count_in_every_direction() -> None:
    """Three single hits: in the cell, in a bin above beside it, in a bin below beyond a corner of the tile."""
    own = {4: {(0, 0): (0, {20: 1}), (1, 1): (0, {21: 1})}}
    assert not look(own, FLAT).obstacle.any()
    corner = own | {0: {(63, 63): (-2, {23: 1})}}  # base -2: bin 23 is number 19 from height 0
    got = look(corner, FLAT)
    assert got.obstacle[0, 0] == 1.0
    assert got.obstacle.sum() == 1.0  # cell (1, 1) sees two of them
    two_up = own | {0: {(63, 63): (-2, {26: 1})}}
    assert not look(two_up, FLAT).obstacle.any()
    next_tile = own | {3: {(63, 0): (0, {20: 1})}}
    assert look(next_tile, FLAT).obstacle[0, 0] == 1.0


def test_a_cell_without_hits_of_its_own_has_no_object() -> None:
    around = {(5 + i, 5 + j): (0, {20: 2}) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j}
    got = look({4: around | {(5, 5): (0, {40: 1})}}, FLAT)
    assert got.obstacle[5, 5] == 0.0
    assert got.obstacle[5, 4] == 1.0


def test_unknown_ground_has_nothing_over_it() -> None:
    ground = FLAT.copy()
    ground[5, 5] = np.inf
    for tiles in ({4: {(5, 5): (0, {30: 3})}}, {}):
        got = look(tiles, ground)
        assert np.isnan(got.obstacle[5, 5])
        assert np.nansum(got.obstacle) == 0.0
