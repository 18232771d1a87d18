"""The loops over a scan: which tiles it touches, the ordered update, what then counts as changed."""

import numpy as np

from roughmap.arrays import F8, I4, I8, U1, U8, Scalar
from roughmap.cell import CELL_DTYPE, TILE_CELLS, TILE_SHIFT
from roughmap.footprint import LEAST_SHARE, POINT, shares_of
from roughmap.index import find, place_key, tile_key
from roughmap.jit import inline, kernel
from roughmap.memory import prefetch
from roughmap.place import BLOCK
from roughmap.update import QUEUE, drain

_MASK = np.int64(TILE_CELLS - 1)
_SHIFT = np.int64(TILE_SHIFT)
_ROW = np.uint64(TILE_CELLS)
_BYTES = np.uint64(CELL_DTYPE.itemsize)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


@kernel
def collect_tiles(
    start: int,
    model: int,
    x: F8,
    y: F8,
    reason: U1,
    cells: I4,
    body: F8,
    a: float,
    window: Scalar,
    min_share: float,
    home: I4,
    table: I4,
    keys: U8,
    work: I8,
    number: int,
    lines: F8,
    shares: F8,
) -> tuple[int, int]:
    """Find the tiles in which points take part, from point ``start`` on, in the order of their first touch.

    A touched tile gets a row of ``keys`` and ``work`` (points), found by ``table``; ``home`` says for each point the
    row of its tile, or -1 if its footprint lies in several or past the map's ``window`` (cells i0, j0, i1, j1, both
    ends in it). Returns (point at which the table was half full, or N; rows used).
    """
    w0, v0, w1, v1 = window
    last_key = np.uint64(0)
    last_row: Scalar = np.int64(-1)
    for n in range(start, len(x)):
        home[n] = -1
        if reason[n] != 0:
            continue
        b, k = n // BLOCK, n % BLOCK
        i0, j0, i1, j1 = _corners(cells, b, k)
        tx0, ty0, tx1, ty1 = i0 >> _SHIFT, j0 >> _SHIFT, i1 >> _SHIFT, j1 >> _SHIFT
        # Room for all tiles of this point's footprint, so that a point is never cut in two.
        if 2 * (number + (tx1 - tx0 + 1) * (ty1 - ty0 + 1)) > len(table):
            return n, number
        if tx0 == tx1 and ty0 == ty1 and i0 >= w0 and j0 >= v0 and i1 <= w1 and j1 <= v1:
            key = tile_key(tx0, ty0)
            if last_row < 0 or key != last_key:
                last_key = key
                last_row = find(table, keys, key)
                if last_row < 0:
                    last_row = number
                    keys[number] = key
                    work[number] = 0
                    place_key(table, key, number)
                    number += 1
            home[n] = last_row
            work[last_row] += 1
            continue
        least = 0.0
        if model != POINT:
            least = min_share * shares_of(model, k, x[n], y[n], cells[b], body[b], a, lines, shares)
        else:
            shares[0] = 1.0
        ni = i1 - i0 + 1
        for ty in range(ty0, ty1 + 1):
            for tx in range(tx0, tx1 + 1):
                touched = False
                for j in range(max(j0, v0, ty << _SHIFT), min(j1, v1, (ty << _SHIFT) + _MASK) + 1):
                    for i in range(max(i0, w0, tx << _SHIFT), min(i1, w1, (tx << _SHIFT) + _MASK) + 1):
                        p = shares[(j - j0) * ni + (i - i0)]
                        touched |= p >= least and p > LEAST_SHARE
                if touched:
                    key = tile_key(tx, ty)
                    row = find(table, keys, key)
                    if row < 0:
                        row = number
                        keys[number] = key
                        work[number] = 0
                        place_key(table, key, number)
                        number += 1
                    work[row] += 1
    return len(x), number


@inline
def _corners(cells: I4, b: Scalar, k: Scalar) -> Scalar:
    return np.int64(cells[b, 0, k]), np.int64(cells[b, 1, k]), np.int64(cells[b, 2, k]), np.int64(cells[b, 3, k])


@inline
def _enqueue(
    queue: Scalar,
    count: Scalar,
    n: Scalar,
    address: Scalar,
    bits: U8,
    q: Scalar,
    i0: Scalar,
    j0: Scalar,
    ni: Scalar,
    i_low: Scalar,
    i_high: Scalar,
    j_low: Scalar,
    j_high: Scalar,
    least: Scalar,
    shares: F8,
) -> Scalar:
    """Queue the cells of one tile that a footprint covers; updates that are now in the queue.

    Every cell is written to the queue and the end moved on by those that take part: no branch to be guessed wrong.
    """
    cell, weight, point = queue
    for j in range(j_low, j_high + 1):
        changed = np.uint64(0)
        line = np.uint64(j & _MASK)
        for i in range(i_low, i_high + 1):
            p = shares[(j - j0) * ni + (i - i0)]
            taken = np.uint64((p >= least) & (p > LEAST_SHARE))
            column = np.uint64(i & _MASK)
            where = address + (line * _ROW + column) * _BYTES
            cell[count] = where
            weight[count] = p * q
            point[count] = n
            count += taken
            changed |= taken << column
            prefetch(where)
        bits[line] |= changed
    return count


@kernel
def update_tiles(
    part: int,
    owner: U1,
    model: int,
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    cells: I4,
    body: F8,
    stamps: I8,
    a: float,
    window: Scalar,
    min_share: float,
    min_distance: float,
    home: I4,
    table: I4,
    keys: U8,
    address: U8,
    bits: U8,
    oldest: I8,
    newest: I8,
    lines: F8,
    shares: F8,
    queue: Scalar,
) -> None:
    """Update the cells of the tiles that ``part`` owns, in the order of the points.

    ``stamps``: one for all points, or one a point. ``bits`` (T, 64): a bit for each changed cell, rows along y.
    ``oldest``, ``newest`` (T,) of the tiles' points are widened.
    """
    w0, v0, w1, v1 = window
    each = np.int64(1) if len(stamps) > 1 else np.int64(0)
    count = np.uint64(0)
    for n in range(len(x)):
        if reason[n] != 0:
            continue
        if count >= QUEUE:
            drain(queue, count, z, body, stamps, model, min_distance)
            count = np.uint64(0)
        row = np.int64(home[n])
        if row >= 0 and owner[row] != part:
            continue
        b, k = n // BLOCK, n % BLOCK
        i0, j0, i1, j1 = _corners(cells, b, k)
        ni = i1 - i0 + 1
        least = 0.0
        q = 1.0
        shares[0] = 1.0
        if model != POINT:
            least = min_share * shares_of(model, k, x[n], y[n], cells[b], body[b], a, lines, shares)
            q = body[b, 2, k]
        stamp = stamps[n * each]
        if row >= 0:
            count = _enqueue(queue, count, n, address[row], bits[row], q, i0, j0, ni, i0, i1, j0, j1, least, shares)
            oldest[row] = min(oldest[row], stamp)
            newest[row] = max(newest[row], stamp)
            continue
        for ty in range(j0 >> _SHIFT, (j1 >> _SHIFT) + 1):
            for tx in range(i0 >> _SHIFT, (i1 >> _SHIFT) + 1):
                row = find(table, keys, tile_key(tx, ty))
                if row < 0 or owner[row] != part:
                    continue
                i_low, i_high = max(i0, w0, tx << _SHIFT), min(i1, w1, (tx << _SHIFT) + _MASK)
                j_low, j_high = max(j0, v0, ty << _SHIFT), min(j1, v1, (ty << _SHIFT) + _MASK)
                before = count
                count = _enqueue(
                    queue, count, n, address[row], bits[row], q, i0, j0, ni, i_low, i_high, j_low, j_high, least, shares
                )
                if count != before:
                    oldest[row] = min(oldest[row], stamp)
                    newest[row] = max(newest[row], stamp)
    drain(queue, count, z, body, stamps, model, min_distance)


@inline
def _low_bits(number: Scalar) -> Scalar:
    """A word with the lowest ``number`` (cut to 0 .. 64) bits set."""
    if number <= 0:
        return np.uint64(0)
    if number >= TILE_CELLS:
        return _ALL
    return (np.uint64(1) << np.uint64(number)) - np.uint64(1)


@kernel
def mark_changed(level: int, table: I4, keys: U8, sequence: I8, tx: I4, ty: I4, bits: U8, now: int) -> None:
    """Give sequence ``now`` to the tiles of a level that changed, or whose one-cell ring changed.

    ``tx``, ``ty`` (T,), ``bits`` (T, 64): level-0 tiles with their changed cells. A neighbour's ring is what lies
    within one cell of this level, 2^level cells of level 0, of the border between them.
    """
    side = np.int64(1) << level
    for n in range(len(tx)):
        x = np.int64(tx[n]) >> level
        y = np.int64(ty[n]) >> level
        # The tile's place within its ancestor, in cells of level 0; the ancestor is 64 * side of them wide.
        left = (np.int64(tx[n]) - (x << level)) << _SHIFT
        foot = (np.int64(ty[n]) - (y << level)) << _SHIFT
        west = _low_bits(side - left)
        east = ~_low_bits(_MASK * side - left)
        inner = np.uint64(0)
        south = np.uint64(0)
        north = np.uint64(0)
        for j in range(TILE_CELLS):
            row = bits[n, j]
            inner |= row
            south |= row if foot + j < side else np.uint64(0)
            north |= row if foot + j >= _MASK * side else np.uint64(0)
        for dy in range(-1, 2):
            band = inner
            band = south if dy < 0 else band
            band = north if dy > 0 else band
            for dx in range(-1, 2):
                hit = band
                hit = band & west if dx < 0 else hit
                hit = band & east if dx > 0 else hit
                if hit != 0:
                    entry = find(table, keys, tile_key(x + dx, y + dy))
                    if entry >= 0:
                        sequence[entry] = now
