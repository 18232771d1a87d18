"""Coarser levels: four cells of one level become one cell of the next (Chan's pairwise formula)."""

from collections.abc import Sequence
from math import sqrt

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F4, F8, U2, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS, TRUST_DTYPE
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


@kernel
def _merge_trust(words: F8, trust: F4, out: F4, column: int, row: int) -> None:
    for j in range(HALF):
        for i in range(HALF):
            first = 2 * j * TILE_CELLS + 2 * i
            total = 0.0
            sigma, pose, mount = 0.0, 0.0, 0.0
            for child in (first, first + 1, first + TILE_CELLS, first + TILE_CELLS + 1):
                weight = words[child, 1]
                if weight > 0.0:
                    total += weight
                    share = weight / total  # of the child in the mean so far; a lone child's values stay as they are
                    sigma += (sqrt(np.float64(trust[child, 0])) - sigma) * share
                    pose += (np.float64(trust[child, 2]) - pose) * share
                    mount += (np.float64(trust[child, 3]) - mount) * share
            parent = (row + j) * TILE_CELLS + column + i
            out[parent, 0] = sigma * sigma
            out[parent, 2] = pose
            out[parent, 3] = mount


def merge_trust(cells: Sequence[Records | None], trust: Sequence[Records | None]) -> Records:
    """Merge the trust of four tiles, whose ``cells`` are those of `merge`, into that of the tile of the next level.

    Neighbouring cells were hit by the same scans: their errors are taken as one, so that not the variances but the
    sigmas are averaged, by weight. ``pose_variance`` and ``mount_sigma`` are averaged too; ``shared`` and ``stamp_ms``,
    which only an update needs, are 0. Returns (64, 64) records, read-only.
    """
    out = np.zeros((TILE_CELLS, TILE_CELLS), dtype=TRUST_DTYPE)
    for place, (child, its) in enumerate(zip(cells, trust, strict=True)):
        if child is not None and its is not None:
            _merge_trust(_views(child)[0], _trust(its), _trust(out), (place & 1) * HALF, (place >> 1) * HALF)
    out.flags.writeable = False
    return out


def merge_flags(children: Sequence[U2 | None]) -> U2:
    """Merge (4096, 1) flags of four tiles: a cell has a flag if one of its children has it."""
    out = np.zeros((TILE_CELLS, TILE_CELLS), np.uint16)
    for place, child in enumerate(children):
        if child is not None:
            fine = child.reshape(TILE_CELLS, TILE_CELLS)
            rows = fine[0::2] | fine[1::2]
            j, i = (place >> 1) * HALF, (place & 1) * HALF
            out[j : j + HALF, i : i + HALF] = rows[:, 0::2] | rows[:, 1::2]
    return out.reshape(-1, 1)


def _trust(records: Records) -> F4:
    """Return a view of the 4096 records as (4096, 5) float32."""
    return records.reshape(TILE_CELLS * TILE_CELLS).view(np.float32).reshape(TILE_CELLS * TILE_CELLS, 5)


def _views(records: Records) -> tuple[F8, npt.NDArray[np.uint32]]:
    """Return views of the 4096 records as (4096, 8) float64 and (4096, 16) uint32."""
    cells = TILE_CELLS * TILE_CELLS
    flat = records.reshape(cells)
    return flat.view(np.float64).reshape(cells, 8), flat.view(np.uint32).reshape(cells, 16)
