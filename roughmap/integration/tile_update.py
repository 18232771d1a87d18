"""The tiles of odd points, and the kernel of phase two: the ordered update of all cells."""

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I4, I8, U1, U8, Scalar
from roughmap.cell import CELL_DTYPE, TILE_CELLS, TILE_SHIFT, TRUST_DTYPE
from roughmap.integration.drains import ENTRY, QUEUE, ROW, drain_all, drain_ground, put
from roughmap.intrinsics import pointer, prefetch
from roughmap.jit import inline, kernel
from roughmap.points.footprint import LEAST_SHARE, POINT, box_of, shares_of
from roughmap.points.place import BLOCK
from roughmap.tiles.index import find, find_or_add, tile_key
from roughmap.tiles.slots import TRUST_OFFSET

_MASK = np.int64(TILE_CELLS - 1)
_SHIFT = np.int64(TILE_SHIFT)
_ROW = np.uint64(TILE_CELLS)
_BYTES = np.uint64(CELL_DTYPE.itemsize)
_EAST = _BYTES
_NORTH = _ROW * _BYTES
_TRUST = np.uint64(TRUST_OFFSET)
_TRUST_BYTES = np.uint64(TRUST_DTYPE.itemsize)
_TRUST_NORTH = _ROW * _TRUST_BYTES
_TRUST_END = _TRUST_BYTES - np.uint64(1)
_ONE = np.uint64(1)
_CORNER = np.uint64(TILE_SHIFT)
_BLOCK, _PLAIN_CELLS, _WEIGHT = np.uint64(BLOCK), np.uint64(4), np.uint64(8)


@inline
def _takes_part(p: Scalar, least: Scalar) -> Scalar:
    """Whether a cell with share ``p`` of an odd point is written; used by both phases, so that they agree."""
    return (p >= least) & (p > LEAST_SHARE)


@kernel
def collect_odd(
    start: int, stop: int, planes: Scalar, rules: Scalar, found: Scalar, number: int, lines: F8, shares: F8
) -> tuple[int, int]:
    """Find the tiles of those odd points of rows ``start`` to ``stop`` that lie in several tiles.

    Stops early, between two points, if the table of tiles in ``found`` has no room for the tiles of another point.
    Returns (row at which it stopped, number of tiles).
    """
    table, keys, work, founded, _ = found
    model, a, _, window, _, min_share, _ = rules
    w0, v0, w1, v1 = window
    for n in range(start, stop):
        if planes.odd_tile[n] >= 0:
            continue
        i0, j0, i1, j1 = box_of(planes.odd_box, n)
        tx0, ty0, tx1, ty1 = i0 >> _SHIFT, j0 >> _SHIFT, i1 >> _SHIFT, j1 >> _SHIFT
        if 2 * (number + (tx1 - tx0 + 1) * (ty1 - ty0 + 1)) > len(table):
            return n, number
        least = min_share * shares_of(model, planes.odd_box, planes.odd_body, n, a, lines, shares)
        ni = i1 - i0 + 1
        for ty in range(ty0, ty1 + 1):
            for tx in range(tx0, tx1 + 1):
                touched = False
                for j in range(max(j0, v0, ty << _SHIFT), min(j1, v1, (ty << _SHIFT) + _MASK) + 1):
                    for i in range(max(i0, w0, tx << _SHIFT), min(i1, w1, (tx << _SHIFT) + _MASK) + 1):
                        p = shares[(j - j0) * ni + (i - i0)]
                        touched |= _takes_part(p, least)
                if touched:
                    key = tile_key(tx, ty)
                    row = find(table, keys, key)
                    if row < 0:  # a call counts references to arrays, which costs as much as the rest
                        row, number = find_or_add(table, keys, work, key, number)
                    work[row] += 1
                    if planes.odd_tile[n] == -1:
                        founded[row] = 1
    return stop, number


@inline
def _largest_share(shares: F8, number: Scalar, largest: Scalar) -> Scalar:
    """Return the first cell of a footprint of ``number`` cells whose share is the ``largest``."""
    c = 0
    while c < number - 1 and shares[c] != largest:
        c += 1
    return c


@inline
def _enqueue_odd(
    at: Scalar,
    n: Scalar,
    up: Scalar,
    address: Scalar,
    bits: U8,
    row: Scalar,
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
    main: Scalar,
) -> Scalar:
    """Queue the cells of one tile that a footprint covers, from the address ``at`` on; return where the queue ends.

    Every cell is written to the queue, but its end only moves on for those that count: there is no branch to
    mispredict. ``main``: the cell of the largest share.
    """
    tagged = np.uint64(row) << ROW | np.uint64(n)
    for j in range(j_low, j_high + 1):
        changed = np.uint64(0)
        line = np.uint64(j & _MASK)
        for i in range(i_low, i_high + 1):
            c = (j - j0) * ni + (i - i0)
            p = shares[c]
            taken = np.uint64(_takes_part(p, least))
            column = np.uint64(i & _MASK)
            where = address + (line * _ROW + column) * _BYTES
            believed = address + _TRUST + (line * _ROW + column) * _TRUST_BYTES
            put(at, where + up, -p * q if c == main else p * q, tagged, believed)
            at += taken * ENTRY
            changed |= taken << column
            prefetch(where)
            prefetch(believed)
        bits[row, line] |= changed
    return at


@inline
def _enqueue_plain(
    at: Scalar, n: Scalar, tagged: Scalar, up: Scalar, where: Scalar, believed: Scalar,
    corner: Scalar, bits: U8, row: Scalar, weights: Scalar,
) -> Scalar:  # fmt: skip
    """Do the same for the 2 x 2 cells of a plain point, of which the first is at ``where``, its trust at ``believed``.

    ``weights``: the address of `Planes.weight`. The weights of the next block are prefetched, a part by each point:
    the processor doesn't foresee four short streams.
    """
    first = weights + (n // _BLOCK * _PLAIN_CELLS * _BLOCK + n % _BLOCK) * _WEIGHT
    weight = carray(pointer(first, np.float64(0.0)), (4 * BLOCK,))
    w0, w1 = weight[np.uint64(0)], weight[_BLOCK]
    w2, w3 = weight[np.uint64(2) * _BLOCK], weight[np.uint64(3) * _BLOCK]
    prefetch(weights + (n + _BLOCK) * _PLAIN_CELLS * _WEIGHT)
    t0, t1, t2, t3 = np.uint64(w0 != 0.0), np.uint64(w1 != 0.0), np.uint64(w2 != 0.0), np.uint64(w3 != 0.0)
    prefetch(where)
    prefetch(where + _EAST)
    prefetch(where + _NORTH)
    prefetch(where + _NORTH + _EAST)
    prefetch(believed)
    prefetch(believed + _TRUST_BYTES + _TRUST_END)
    prefetch(believed + _TRUST_NORTH)
    prefetch(believed + _TRUST_NORTH + _TRUST_BYTES + _TRUST_END)
    where |= up
    put(at, where, w0, tagged, believed)
    at += t0 * ENTRY
    put(at, where + _EAST, w1, tagged, believed + _TRUST_BYTES)
    at += t1 * ENTRY
    put(at, where + _NORTH, w2, tagged, believed + _TRUST_NORTH)
    at += t2 * ENTRY
    put(at, where + _NORTH + _EAST, w3, tagged, believed + _TRUST_NORTH + _TRUST_BYTES)
    at += t3 * ENTRY
    line, column = corner >> _CORNER, corner & np.uint64(_MASK)
    bits[row, line] |= (t0 | t1 << _ONE) << column
    bits[row, (line + _ONE) & np.uint64(_MASK)] |= (t2 | t3 << _ONE) << column
    return at


@inline
def _enqueue_point(
    at: Scalar, tagged: Scalar, up: Scalar, where: Scalar, believed: Scalar, corner: Scalar, bits: U8,
    row: Scalar,
) -> Scalar:  # fmt: skip
    """Do the same for the model `point`: one cell, of weight 1."""
    prefetch(where)
    prefetch(believed)
    put(at, where | up, 1.0, tagged, believed)
    bits[row, corner >> _CORNER] |= _ONE << (corner & np.uint64(_MASK))
    return at + ENTRY


@inline
def _widen(oldest: I8, newest: I8, row: Scalar, stamps: I8, first: Scalar, last: Scalar) -> None:
    """Extend the range of a tile's stamps by those of points ``first`` to ``last``."""
    low = high = stamps[0]
    if len(stamps) > 1:
        low = high = stamps[first]
        for n in range(first + 1, last):
            low, high = min(low, stamps[n]), max(high, stamps[n])
    oldest[row] = min(oldest[row], low)
    newest[row] = max(newest[row], high)


@inline
def _enqueue_run(
    at: Scalar, first: Scalar, last: Scalar, base: Scalar, bits: U8, row: Scalar, planes: Scalar,
    model: Scalar,
) -> Scalar:  # fmt: skip
    """Do the same for a run of plain points in the tile at ``base``."""
    tag, believed, weights = np.uint64(row) << ROW, base + _TRUST, np.uint64(planes.weight.ctypes.data)
    for n in range(first, last):
        point = np.uint64(n)
        corner, up, tagged = np.uint64(planes.corner[point]), np.uint64(planes.up[point]), tag | point
        where, trust = base + corner * _BYTES, believed + corner * _TRUST_BYTES
        if model == POINT:
            at = _enqueue_point(at, tagged, up, where, trust, corner, bits, np.uint64(row))
        else:
            at = _enqueue_plain(at, point, tagged, up, where, trust, corner, bits, np.uint64(row), weights)
    return at


@inline
def _drain(
    queue: Scalar, count: Scalar, planes: Scalar, stamps: I8, rules: Scalar, measures: Scalar, tiles: U8
) -> None:
    min_distance, band, pose_error_time = measures
    if rules[6]:
        drain_ground(queue, count, planes, stamps, rules[0], min_distance, pose_error_time, band, tiles)
    else:
        drain_all(queue, count, planes, stamps, rules[0], min_distance, pose_error_time)


@inline
def _skip_up(planes: Scalar, n: Scalar, stop: Scalar) -> Scalar:
    """Return the first point from ``n`` on that can be ground, or ``stop``."""
    while n < stop and planes.up[n] != 0:
        n += 1
    return n


@kernel
def update_tiles(
    part: int,
    owner: U1,
    starts: I8,
    ends: I8,
    planes: Scalar,
    stamps: I8,
    rules: Scalar,
    measures: Scalar,
    rows: I4,
    table: I4,
    keys: U8,
    tiles: U8,
    begun: U1,
    bits: U8,
    oldest: I8,
    newest: I8,
    lines: F8,
    shares: F8,
    queue: Scalar,
) -> None:
    """Update the cells of the tiles that ``part`` owns, in the order of the points.

    ``starts``, ``ends`` (Q,): the rows of the runs of each range of phase one. ``rows`` (Q, R): the rows in the merged
    table of the tiles that each range touches. ``stamps``: (1,) for all points, or (N,). ``measures``: min_distance,
    band, pose_error_time. ``tiles``: see `drain_ground`. ``begun`` (T,): 1 for tiles that exist; a tile begins to exist
    with its first point that can be ground, and takes no notice of any before. ``bits`` (T, 64) receives a bit for each
    touched cell, rows along y. ``oldest``, ``newest`` (T,) are extended by the stamps of the points.
    """
    model, a, _, window, _, min_share, _ = rules
    w0, v0, w1, v1 = window
    start = at = np.uint64(queue.ctypes.data)
    full = start + np.uint64(QUEUE) * ENTRY
    for found in range(len(starts)):
        for run in range(starts[found], ends[found]):
            home = np.int64(planes.run_tile[run])
            odd = -1 - home
            row = np.int64(planes.odd_tile[odd]) if home < 0 else home
            if row >= 0:
                row = np.int64(rows[found, row])
                if owner[row] != part:
                    continue
            if at >= full:
                _drain(start, at, planes, stamps, rules, measures, tiles)
                at = start
            n, stop = np.int64(planes.run_start[run]), np.int64(planes.run_stop[run])
            if row >= 0 and begun[row] == 0:
                n = _skip_up(planes, n, stop)
                if n == stop:
                    continue
                begun[row] = 1
            if home >= 0:
                at = _enqueue_run(at, n, stop, tiles[row, 0], bits, row, planes, model)
                _widen(oldest, newest, row, stamps, n, stop)
                continue
            i0, j0, i1, j1 = box_of(planes.odd_box, odd)
            ni = i1 - i0 + 1
            largest = shares_of(model, planes.odd_box, planes.odd_body, odd, a, lines, shares)
            least = min_share * largest
            main = _largest_share(shares, ni * (j1 - j0 + 1), largest)
            q, up = planes.q[n] if model != POINT else 1.0, np.uint64(planes.up[n])
            if row >= 0:
                at = _enqueue_odd(
                    at, n, up, tiles[row, 0], bits, row, q, i0, j0, ni, i0, i1, j0, j1, least, shares, main
                )
                _widen(oldest, newest, row, stamps, n, stop)
                continue
            for ty in range(j0 >> _SHIFT, (j1 >> _SHIFT) + 1):
                for tx in range(i0 >> _SHIFT, (i1 >> _SHIFT) + 1):
                    row = find(table, keys, tile_key(tx, ty))
                    if row < 0 or owner[row] != part or (begun[row] == 0 and up != 0):
                        continue
                    i_low, i_high = max(i0, w0, tx << _SHIFT), min(i1, w1, (tx << _SHIFT) + _MASK)
                    j_low, j_high = max(j0, v0, ty << _SHIFT), min(j1, v1, (ty << _SHIFT) + _MASK)
                    before = at
                    at = _enqueue_odd(
                        at, n, up, tiles[row, 0], bits, row, q, i0, j0, ni, i_low, i_high, j_low, j_high,
                        least, shares, main,
                    )  # fmt: skip
                    if at != before:
                        begun[row] = 1
                        _widen(oldest, newest, row, stamps, n, stop)
    _drain(start, at, planes, stamps, rules, measures, tiles)
