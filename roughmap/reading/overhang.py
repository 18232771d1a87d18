"""What stands on the ground or hangs over it: from the columns of a tile and of the cells beside it."""

from dataclasses import dataclass
from math import inf, nan, sqrt

import numpy as np

from roughmap.arrays import F8, U1, Scalar
from roughmap.cell import BASED, BIN_HEIGHT, COLUMN_BINS, COLUMN_DTYPE, TILE_CELLS, TILE_SHIFT
from roughmap.jit import inline, kernel

FLAGS_AT, BASE_AT, BINS_AT = (COLUMN_DTYPE.fields[name][1] for name in ("flags", "base", "bins"))  # type: ignore[index]
"""Bytes before these members of a column. Their values are read byte by byte, the lowest first."""

SLOPE_PART = 0.7
"""A tilted ground fills a cell up to half its diagonal times the gradient above the mean; 0.7 of the side."""

OBJECT_HITS = 3
"""Hits in 3 x 3 cells x 3 bins that make an object; fewer may be strays."""

Columns = tuple[U1, ...]
"""The columns of a tile and its eight neighbours as bytes, each (4096, 64), or NO_COLUMN of one row."""


@dataclass(frozen=True)
class Overhang:
    """Layers of a tile, each (64, 64) float64, heights over the ground in metres.

    ``obstacle``: 1 where something is in a robot's way, else 0; NaN where the ground is unknown. ``obstacle_top``: the
    highest of it below the clearance; ``overhang_low``: the lowest above; NaN if there is none.
    """

    obstacle: F8
    obstacle_top: F8
    overhang_low: F8


@inline
def _hits(column: U1, c: Scalar, k: Scalar) -> Scalar:
    """Return the hits in bin ``k`` of a cell; 0 outside the bins."""
    if k < 0 or k >= COLUMN_BINS:
        return np.int64(0)
    return (np.int64(column[c, BINS_AT + (k >> 1)]) >> ((k & 1) * 4)) & 15


@inline
def _base(column: U1, c: Scalar) -> Scalar:
    """Return the number of the lowest bin of a cell, counted from height 0."""
    word = np.uint32(0)
    for byte in range(4):
        word |= np.uint32(column[c, BASE_AT + byte]) << np.uint32(8 * byte)
    return 2 * np.int64(np.int32(word))


@inline
def _is_object(columns: Columns, j: int, i: int, number: Scalar) -> bool:
    """Whether the bins ``number`` - 1 to + 1 of cell (i, j) and the eight around it have enough hits.

    ``number``: counted from height 0, since each cell's bins begin elsewhere.
    """
    hits = np.int64(0)
    for dj in range(-1, 2):
        for di in range(-1, 2):
            y, x = j + dj, i + di
            place = 3 * ((y >> TILE_SHIFT) + 1) + (x >> TILE_SHIFT) + 1
            column = columns[place]
            if len(column) == 1:
                continue
            c = ((y & (TILE_CELLS - 1)) << TILE_SHIFT) | (x & (TILE_CELLS - 1))
            if (column[c, FLAGS_AT] & BASED) == 0:
                continue
            k = number - _base(column, c)
            hits += _hits(column, c, k - 1) + _hits(column, c, k) + _hits(column, c, k + 1)
            if hits >= OBJECT_HITS:
                return True
    return False


@kernel
def _look(columns: Columns, ground: F8, gx: F8, gy: F8, side: float, step: float, clearance: float, out: F8) -> None:
    """Fill ``out`` (3, 64, 64): obstacle, its top, the lowest overhang. ``ground``: heights, infinite where unknown."""
    own = columns[4]
    for j in range(TILE_CELLS):
        for i in range(TILE_CELLS):
            known = ground[j, i] < inf
            out[0, j, i] = 0.0 if known else nan
            out[1, j, i] = nan
            out[2, j, i] = nan
            c = j * TILE_CELLS + i
            if not known or (own[c, FLAGS_AT] & BASED) == 0:
                continue
            gradient = sqrt(gx[j, i] * gx[j, i] + gy[j, i] * gy[j, i])
            lowest = step + (SLOPE_PART * gradient * side if gradient >= 0.0 else 0.0)
            base = _base(own, c)
            high = 0
            while high < COLUMN_BINS and (base + high + 0.5) * BIN_HEIGHT - ground[j, i] < clearance:
                high += 1
            for k in range(high - 1, -1, -1):
                height = (base + k + 0.5) * BIN_HEIGHT - ground[j, i]
                if height <= lowest:
                    break
                if _hits(own, c, k) > 0 and _is_object(columns, j, i, base + k):
                    out[0, j, i] = 1.0
                    out[1, j, i] = height
                    break
            for k in range(high, COLUMN_BINS):
                height = (base + k + 0.5) * BIN_HEIGHT - ground[j, i]
                if height > lowest and _hits(own, c, k) > 0 and _is_object(columns, j, i, base + k):
                    out[2, j, i] = height
                    break


def overhang(columns: Columns, ground: F8, gx: F8, gy: F8, side: float, step: float, clearance: float) -> Overhang:
    """Return what stands on a tile's ground and hangs over it.

    ``columns``: of nine tiles, south to north and west to east. ``ground`` (64, 64): heights, metres, infinite where
    unknown. ``gx``, ``gy`` (64, 64): its gradients, NaN without a plane. ``side``: of a cell, metres. Bins up to the
    limit ``step`` over the ground, and as far as its slope reaches within a cell, belong to the ground.
    """
    if len(columns[4]) == 1:
        out = np.full((3, TILE_CELLS, TILE_CELLS), np.nan)
        out[0, ground < inf] = 0.0
        return Overhang(*out)
    out = np.empty((3, TILE_CELLS, TILE_CELLS))
    _look(columns, ground, gx, gy, side, step, clearance, out)
    return Overhang(*out)
