"""Clearing: what a scan saw through is no longer there.

Hits in the columns of cells stay, even those of people who have walked on. A scan takes them away again: if it saw past
an occupied bin near the sensor, the hits of that bin are halved. The scan's own points have been added by then: what is
still there has new hits, and blocks the view.
"""

import math
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F4, I4, I8, U1, U8, Scalar
from roughmap.cell import BASED, BIN_HEIGHT, COLUMN_DTYPE, TILE_CELLS, TILE_SHIFT
from roughmap.integration.range_image import AZIMUTHS, RESOLUTION, ROWS, azimuth_of, look_around, range_image, row_of
from roughmap.integration.viewpoint import Viewpoint, is_inside, viewpoint_of
from roughmap.integration.workspace import Planes, ThreadScratch, Workspace
from roughmap.intrinsics import trailing_zeros
from roughmap.jit import inline, kernel
from roughmap.points.scan import Limits, Scan
from roughmap.points.trajectory import Trajectory
from roughmap.tiles.index import TILE_LIMIT, paired
from roughmap.tiles.slots import words
from roughmap.tiles.table import TileTable

REACH = 1.0 / RESOLUTION
"""Distance, in cells, up to which a cell is at least as wide as a pixel of the range image."""

_NEAREST = 0.5
"""Cells nearer than this are under the sensor or beside it, metres."""

_MARGIN = 0.3
"""What is seen no farther than this behind a bin may be the same thing, metres."""

_WORDS = COLUMN_DTYPE.itemsize // 8
_BASED = np.uint64(BASED << 16)
_FIRST_BINS = 3
"""Words of a column: 0 holds its flags, 2 its base, 3 to 7 its bins, 16 each."""

_FOURS = np.uint64(60)
_TWO = np.uint64(2)
_NIBBLE = np.uint64(15)
_ONE = np.uint64(1)


class Look(NamedTuple):
    """A scan that clears: who looked, and from where."""

    scan: Scan
    trajectory: Trajectory
    limits: Limits


class Sight(NamedTuple):
    """What a scan saw; overwritten when the next one is prepared.

    ``viewpoint``: from where. ``clear_to``, ``rows``: see `look_around`. ``entries``: the map's tiles within reach.
    """

    viewpoint: Viewpoint
    clear_to: F4
    rows: U1
    entries: I4


def prepare_clearing(look: Look, planes: Planes, table: TileTable, a: float, space: Workspace) -> Sight:
    """Find out what a scan saw, after phase one, which accepted some of its points. ``a``: the cell's side.

    The map does not change, and its lock is not needed. Bring back the ``entries`` next. In phase two, make those of
    them writable that `with_columns` returns before any cell is updated, and call `clear` when all are.
    """
    number = len(look.scan.points)
    reason = planes.reason[:number]
    viewpoint = viewpoint_of(look.scan, look.trajectory, look.limits, reason)
    image, clear_to, rows = space.image
    image.fill(np.inf)
    range_image(planes.x[:number], planes.y[:number], planes.z[:number], reason, viewpoint.origin, image)
    look_around(image, clear_to, rows)
    return Sight(viewpoint, clear_to, rows, _within_reach(table, viewpoint, a))


def _within_reach(table: TileTable, viewpoint: Viewpoint, a: float) -> I4:
    """Return the entries of the tiles that may have a cell within reach, ascending by (tx, ty)."""
    box = []
    for sign in (-1.0, 1.0):
        for k in range(2):
            tile = (viewpoint.origin[k] / a + sign * (REACH + 1.0)) / TILE_CELLS
            box.append(math.floor(min(max(-TILE_LIMIT, tile), TILE_LIMIT - 1)))
    return table.select((box[0], box[1], box[2], box[3]))


def with_columns(table: TileTable, entries: I4) -> I4:
    """Return those of these entries that have a column. ValueError if one is on the shelf."""
    slots = table.slot[entries]
    if (slots < 0).any():
        raise ValueError("expected tiles in memory, found one on the shelf")
    based: I4 = entries[table.pool.column_address[slots] != 0]
    return based


def clear(sight: Sight, table: TileTable, a: float, space: Workspace, sequence: int) -> tuple[int, I4]:
    """Halve the hits of every bin that the scan saw through, and mark the cells as changed by ``sequence``; return the
    number of these bins, and the (T, 2) tiles in which they are.

    All tiles within reach must be in memory, and those with a column writable.
    """
    base = table.levels[0]
    near = _within_reach(table, sight.viewpoint, a)  # again: some tiles are new
    table.used[near] = sequence
    entries = with_columns(table, near)
    number = len(entries)
    address, tx, ty = table.pool.column_address[table.slot[entries]], base.tx[entries], base.ty[entries]
    bits, cleared = np.zeros((number, TILE_CELLS), np.uint64), np.zeros(number, np.int64)
    parts = max(1, min(space.threads, number))

    def work(part: int, _: ThreadScratch) -> None:
        clear_tiles(part, parts, address, tx, ty, a, sight.viewpoint, sight.clear_to, sight.rows, bits, cleared)

    space.run(parts, work)
    changed = cleared > 0
    tx, ty = tx[changed], ty[changed]
    table.mark_changed(entries[changed], tx, ty, bits[changed], sequence)
    return int(cleared.sum()), paired(tx, ty)


@inline
def _clear_column(
    column: U8, at: Scalar, x: Scalar, y: Scalar, d: Scalar, far: F4, viewpoint: Scalar, rows: U1
) -> Scalar:
    """Halve the bins of the column at word ``at`` that were seen through; return their number."""
    origin, axes, edges = viewpoint
    declared = edges[0]
    base = np.int64(column[at + 2]) >> 32
    number = 0
    for word in range(_FIRST_BINS, _WORDS):
        bins = column[at + word]
        if bins == 0:
            continue
        kept = bins
        while bins != 0:
            shift = trailing_zeros(bins) & _FOURS
            hits = (bins >> shift) & _NIBBLE
            bins &= ~(_NIBBLE << shift)
            k = (word - _FIRST_BINS) * 16 + np.int64(shift >> _TWO)
            z = (float(2 * base + k) + 0.5) * BIN_HEIGHT - origin[2]
            row = row_of(z, d)
            if not (row >= 1.0 and row < ROWS - 1):
                continue
            v = np.int64(row)
            clear = far[v]
            if abs(clear) < d + _MARGIN:
                continue
            if clear < 0.0 and not (declared and rows[v] != 0 and is_inside(axes, edges, x, y, z)):
                continue
            kept -= (hits - (hits >> _ONE)) << shift
            number += 1
        if kept != column[at + word]:
            column[at + word] = kept
    return number


@kernel
def clear_tiles(
    part: int, parts: int, address: U8, tx: I4, ty: I4, a: float, viewpoint: Scalar, clear_to: F4, rows: U1, bits: U8,
    cleared: I8,
) -> None:  # fmt: skip
    """Clear every ``parts``-th tile, from ``part`` on.

    ``address`` (T,): of the tiles' columns. ``bits`` (T, 64) receives a bit for each changed cell, rows along y;
    ``cleared`` (T,) the number of halved bins.
    """
    origin = viewpoint[0]
    reach = a / RESOLUTION
    for n in range(part, len(address), parts):
        column = words(address[n])
        west, south = np.int64(tx[n]) << TILE_SHIFT, np.int64(ty[n]) << TILE_SHIFT
        total = 0
        for j in range(TILE_CELLS):
            y = (float(south + j) + 0.5) * a - origin[1]
            changed = np.uint64(0)
            half = math.sqrt(max(reach * reach - y * y, 0.0)) + a
            left: Scalar = max(np.int64(math.floor((origin[0] - half) / a)) - west, 0)
            right: Scalar = min(np.int64(math.floor((origin[0] + half) / a)) - west, TILE_CELLS - 1)
            for i in range(left, right + 1):
                at = (j * TILE_CELLS + i) * _WORDS
                if column[at] & _BASED == 0:
                    continue
                x = (float(west + i) + 0.5) * a - origin[0]
                d = math.sqrt(x * x + y * y)
                if not (d >= _NEAREST and d <= reach):
                    continue
                u = min(np.int64(azimuth_of(x, y)), np.int64(AZIMUTHS - 1))
                number = _clear_column(column, at, x, y, d, clear_to[u], viewpoint, rows)
                if number:
                    total += number
                    changed |= _ONE << np.uint64(i)
            bits[n, j] |= changed
        cleared[n] = total
