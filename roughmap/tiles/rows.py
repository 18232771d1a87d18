"""Rows of a tile in memory: which hold something, and copying only those."""

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import U8, Scalar
from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, TILE_CELLS, TRUST_DTYPE
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel

CELL_ROW, TRUST_ROW, COLUMN_ROW = (
    TILE_CELLS * dtype.itemsize // 8 for dtype in (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE)
)
"""Eight-byte words of a row of each of a tile's arrays."""

_CELL_WORDS = CELL_DTYPE.itemsize // 8  # word 0 is count | updated << 32
_COLUMN_WORDS = COLUMN_DTYPE.itemsize // 8  # word 0 is candidates | flags << 16
_BASED = np.uint64(BASED << 16)
_ONE = np.uint64(1)


@inline
def _words(address: Scalar, number: Scalar) -> U8:
    """Return ``number`` words at ``address``."""
    return carray(pointer(address, np.uint64(0)), (number,))


@kernel
def known_rows(address: Scalar) -> int:
    """Return which rows of the cells at ``address`` hold a known cell: bit j for row j."""
    cells = _words(address, TILE_CELLS * CELL_ROW)
    rows = np.uint64(0)
    for j in range(TILE_CELLS):
        known = np.uint64(0)
        for i in range(TILE_CELLS):
            known |= cells[j * CELL_ROW + i * _CELL_WORDS]
        if known != 0:
            rows |= _ONE << np.uint64(j)
    return rows  # type: ignore[return-value]


@kernel
def based_rows(address: Scalar, rows: Scalar) -> int:
    """Return which of ``rows`` of the column at ``address`` hold a based cell. Others, if any, are not looked at."""
    column = _words(address, TILE_CELLS * COLUMN_ROW)
    found = np.uint64(0)
    for j in range(TILE_CELLS):
        if (rows >> np.uint64(j)) & _ONE:
            based = np.uint64(0)
            for i in range(TILE_CELLS):
                based |= column[j * COLUMN_ROW + i * _COLUMN_WORDS]
            if based & _BASED:
                found |= _ONE << np.uint64(j)
    return found  # type: ignore[return-value]


@kernel
def copy_rows(source: Scalar, target: Scalar, rows: Scalar, row_words: int) -> None:
    """Copy ``rows``, of ``row_words`` words each, of an array at ``source`` to the one at ``target``."""
    size = np.int64(row_words)
    for j in range(TILE_CELLS):
        if (rows >> np.uint64(j)) & _ONE:
            start = np.uint64(j * size * 8)
            a = _words(source + start, size)
            b = _words(target + start, size)
            for k in range(size):
                b[k] = a[k]
