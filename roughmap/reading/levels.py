"""Coarser levels: four cells of one level become one cell of the next (Chan's pairwise formula)."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.jit import kernel

HALF = TILE_CELLS // 2

COUNT_LIMIT = (1 << 32) - 1
"""Counts stop here instead of wrapping to 0, which would mean an unknown cell."""


@kernel
def _merge_quadrant(
    words: F8,
    halves: npt.NDArray[np.uint32],
    out_words: F8,
    out_halves: npt.NDArray[np.uint32],
    column: int,
    row: int,
) -> None:
    for j in range(HALF):
        for i in range(HALF):
            parent = (row + j) * TILE_CELLS + column + i
            first = 2 * j * TILE_CELLS + 2 * i
            known = False
            for child in (first, first + 1, first + TILE_CELLS, first + TILE_CELLS + 1):
                if halves[child, 0] == 0:
                    continue
                if not known:
                    known = True
                    out_halves[parent, 0] = halves[child, 0]
                    out_halves[parent, 1] = halves[child, 1]
                    for k in range(1, 8):
                        out_words[parent, k] = words[child, k]
                    continue
                count = np.int64(out_halves[parent, 0]) + np.int64(halves[child, 0])
                out_halves[parent, 0] = COUNT_LIMIT if count > COUNT_LIMIT else count
                out_halves[parent, 1] = max(out_halves[parent, 1], halves[child, 1])
                weight = out_words[parent, 1]
                more = words[child, 1]
                total = weight + more
                share = more / total
                delta = words[child, 3] - out_words[parent, 3]
                out_words[parent, 1] = total
                out_words[parent, 2] += words[child, 2]
                out_words[parent, 3] += delta * share
                out_words[parent, 4] += words[child, 4] + weight * share * (delta * delta)
                out_words[parent, 5] = min(out_words[parent, 5], words[child, 5])
                out_words[parent, 6] = max(out_words[parent, 6], words[child, 6])
                out_words[parent, 7] += words[child, 7]


def merge(children: Sequence[Records | None]) -> Records:
    """Merge four tiles, cell by cell, into the tile of the next level.

    ``children``: the tiles (2x, 2y), (2x+1, 2y), (2x, 2y+1), (2x+1, 2y+1), each 4096 records of ``CELL_DTYPE`` with j
    outer and i inner, in any shape, or None if absent. In each cell the first known child is copied; each further known
    child B is merged with the result so far, A, by

        W = Wa + Wb,  mean = mean_a + delta Wb / W,  m2 = m2_a + m2_b + delta^2 Wa Wb / W,  delta = mean_b - mean_a

    with sums of ``count`` (at most 2^32 - 1), ``weight_sq`` and ``inv_cf``, the minimum of ``min``, and the maximum of
    ``updated`` and ``max``. Returns (64, 64) records, row = j along y, column = i along x, read-only.
    """
    out = np.zeros((TILE_CELLS, TILE_CELLS), dtype=CELL_DTYPE)
    out_words, out_halves = _views(out)
    for place, child in enumerate(children):
        if child is not None:
            words, halves = _views(child)
            _merge_quadrant(words, halves, out_words, out_halves, (place & 1) * HALF, (place >> 1) * HALF)
    out.flags.writeable = False
    return out


def _views(records: Records) -> tuple[F8, npt.NDArray[np.uint32]]:
    """Return views of the 4096 records as (4096, 8) float64 and (4096, 16) uint32."""
    cells = TILE_CELLS * TILE_CELLS
    flat = records.reshape(cells)
    return flat.view(np.float64).reshape(cells, 8), flat.view(np.uint32).reshape(cells, 16)
