"""A tile's cells with those around it: the planes that the ground is judged by, from the tile and its eight neighbours.

All planes have rows along y and columns along x, and ``width`` more cells on each side than the tile.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8, U1, U2, U8
from roughmap.cell import COLUMN_DTYPE, SUPPORTED, TILE_CELLS
from roughmap.jit import kernel
from roughmap.reading.cell_values import LOW_HALF, M2_AT, MEAN_AT, WEIGHT_AT, WEIGHT_SQ_AT, as_words
from roughmap.reading.layers import SINGLE_POINT
from roughmap.tiles.state import TileState

FLAGS_AT = COLUMN_DTYPE.fields["flags"][1] // 2  # type: ignore[index]
"""The flags' place in a column, in units of two bytes."""

NO_FLAGS = np.zeros((1, 1), np.uint16)
"""Flags of a tile without a column."""

NO_COLUMN = np.zeros((1, COLUMN_DTYPE.itemsize), np.uint8)
NO_COLUMN.flags.writeable = False

PLENTY = 8.0
"""From this number of points on, a cell weighs no more in a plane."""


class Neighbour(NamedTuple):
    """One of the nine tiles: its cells, as `as_words` returns them, and whether their ground is confirmed.

    ``flags`` (4096, n): bit SUPPORTED of word ``at`` of each row; NO_FLAGS if no cell has it. ``column`` (4096, 64):
    its bytes, or NO_COLUMN.
    """

    heads: U8
    words: F8
    flags: U2
    at: int
    column: U1


class Halo(NamedTuple):
    """Planes (64 + 2 width, 64 + 2 width) of a tile with its surroundings.

    ``mean``: heights, infinite where unknown. ``expected``: n, 0 where unknown. ``weight``: of the cell in a plane.
    ``scatter``: m2 n / W, and ``free``: n - 1; both 0 where n is at most 1. ``confirmed``: 1 where the ground was
    confirmed by what came after it.
    """

    mean: F8
    expected: F8
    weight: F8
    scatter: F8
    free: F8
    confirmed: F8


@kernel
def _copy(
    heads: U8, words: F8, flags: U2, at: int, rows: tuple[int, int, int], columns: tuple[int, int, int], out: F8
) -> None:
    """Copy the cells of a tile from ``rows`` (first, end, place in ``out``) and ``columns`` (the same)."""
    some = len(flags) > 1
    for j in range(rows[0], rows[1]):
        y = rows[2] + j - rows[0]
        for i in range(columns[0], columns[1]):
            x = columns[2] + i - columns[0]
            c = j * TILE_CELLS + i
            count = heads[c, 0] & LOW_HALF
            if count == 0:
                continue
            weight = words[c, WEIGHT_AT]
            expected = weight * weight / words[c, WEIGHT_SQ_AT]
            out[0, y, x] = words[c, MEAN_AT]
            out[1, y, x] = expected
            out[2, y, x] = min(np.float64(count), PLENTY)
            if expected > SINGLE_POINT:
                out[3, y, x] = words[c, M2_AT] * (expected / weight)
                out[4, y, x] = expected - 1.0
            if some and flags[c, at] & SUPPORTED:
                out[5, y, x] = 1.0


def surroundings(tiles: Sequence[Neighbour | None], width: int) -> Halo:
    """Return the planes of the fifth of nine ``tiles`` and ``width`` < 64 cells around it.

    ``tiles``: south to north, in each row west to east; None if absent.
    """
    size = TILE_CELLS + 2 * width
    out = np.zeros((len(Halo._fields), size, size))
    out[0] = np.inf
    spans = (TILE_CELLS - width, TILE_CELLS, 0), (0, TILE_CELLS, width), (0, width, TILE_CELLS + width)
    for place, tile in enumerate(tiles):
        if tile is not None:
            _copy(*tile[:4], spans[place // 3], spans[place % 3], out)
    return Halo(*out)


def fine_neighbour(state: TileState) -> Neighbour:
    """Return a tile of level 0, whose columns have the flags."""
    if state.column is None:
        return Neighbour(*as_words(state.cells), NO_FLAGS, 0, NO_COLUMN)
    flags: U2 = state.column.view(np.uint16).reshape(TILE_CELLS * TILE_CELLS, -1)
    column: U1 = state.column.view(np.uint8).reshape(TILE_CELLS * TILE_CELLS, -1)
    column.flags.writeable = False
    return Neighbour(*as_words(state.cells), flags, FLAGS_AT, column)
