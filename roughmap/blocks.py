"""Phase one of an `add`: the geometry of its points, block after block, up to the tiles in which they lie."""

import numpy as np

from roughmap.arrays import F8, I8, Scalar
from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.footprint import CUBOID, POINT, bound_cuboids, bound_ellipsoids, bound_points
from roughmap.index import find, place_key, tile_key
from roughmap.jit import inline, kernel
from roughmap.place import BLOCK, S, X, Y, Z, place_moving, place_still
from roughmap.plain import flag_points, weigh_cuboids, weigh_ellipsoids, within
from roughmap.strided import read_points

_MASK = TILE_CELLS - 1


@inline
def _weigh(first: Scalar, planes: Scalar, block: Scalar, rules: Scalar) -> None:
    """Bound a block's points that are placed, and weigh the plain ones."""
    model, a, area, window, error, min_share = rules
    part = slice(first, first + BLOCK)
    z, reason, q, weight = planes.z[part], planes.reason[part], planes.q[part], planes.weight[first // BLOCK]
    P, cells, body, plain = block.planes, block.cells, block.body, block.plain
    for n in range(BLOCK):
        z[n] = P[Z, n]
    if model == POINT:
        bound_points(P, reason, cells, a, area)
        flag_points(reason, cells, window, plain)
    elif model == CUBOID:
        bound_cuboids(P, reason, cells, body, q, a, area, error)
        weigh_cuboids(P, reason, cells, body, q, a, window, min_share, weight, plain)
    else:
        bound_ellipsoids(P, reason, cells, body, q, plain, a, area, error)
        weigh_ellipsoids(P, reason, cells, body, q, a, window, min_share, weight, plain)


@inline
def _assign(
    first: Scalar, size: Scalar, planes: Scalar, block: Scalar, window: Scalar, found: Scalar, number: Scalar,
    odd: Scalar,
) -> Scalar:  # fmt: skip
    """Find the tile of each plain point of a block, and lay the odd ones aside from row ``odd`` on.

    There is room for a block's tiles. Returns (tiles, the next row for an odd point).
    """
    table, keys, work, rejected = found
    cells, body = block.cells, block.body
    last_key = np.uint64(0)
    row: Scalar = np.int64(-1)
    run = 0
    for n in range(size):
        k = first + n
        plain = block.plain[n] != 0
        if not plain and planes.reason[k] != 0:
            planes.home[k] = -1
            rejected[planes.reason[k]] += 1
            continue
        i, j = cells[0, n], cells[1, n]
        if not plain:
            planes.home[k] = -2 - odd
            planes.odd_box[odd, 0] = i
            planes.odd_box[odd, 1] = j
            planes.odd_box[odd, 2] = cells[2, n]
            planes.odd_box[odd, 3] = cells[3, n]
            planes.odd_body[odd, 0] = block.planes[X, n]
            planes.odd_body[odd, 1] = block.planes[Y, n]
            for m in range(4):
                planes.odd_body[odd, 2 + m] = body[m, n]
            odd += 1
            if not within(i, j, cells[2, n], cells[3, n], window):
                planes.odd_home[odd - 1] = -1
                continue
        key = tile_key(i >> TILE_SHIFT, j >> TILE_SHIFT)
        if row < 0 or key != last_key:
            if run:
                work[row] += run
                run = 0
            last_key = key
            row = find(table, keys, key)
            if row < 0:
                row = number
                keys[number] = key
                work[number] = 0
                place_key(table, key, number)
                number += 1
        run += 1
        if plain:
            planes.home[k] = row
            planes.corner[k] = (j & _MASK) << TILE_SHIFT | (i & _MASK)
        else:
            planes.odd_home[odd - 1] = row
    if run:
        work[row] += run
    return number, odd


@kernel
def scan_blocks(
    start: int,
    stop: int,
    odd: int,
    planes: Scalar,
    block: Scalar,
    source: Scalar,
    offsets: I8,
    moving: bool,
    stamp: int,
    way: Scalar,
    max_gap_ns: float,
    posed: bool,
    pose: Scalar,
    returns: Scalar,
    rules: Scalar,
    found: Scalar,
    number: int,
) -> tuple[int, int, int]:
    """Place, bound and weigh the points of a scan from ``start``, where a block begins, to ``stop``; find their tiles.

    What is known of a point only on the way lives as long as its block. Stops early where the table of tiles in
    ``found`` has no room for another block. Returns (point at which it stopped, next row for an odd point,
    number of tiles).
    """
    for first in range(start, stop, BLOCK):
        if 2 * (number + BLOCK) > len(found[0]):
            return first, odd, number
        size = min(BLOCK, stop - first)
        reason = planes.reason[first : first + BLOCK]
        read_points(source, first, size, block.planes)
        with_covariance = rules[0] != POINT
        if moving:
            place_moving(
                block.planes, reason, offsets, first, size, block.bracket, with_covariance, stamp, way,
                max_gap_ns, returns,
            )  # fmt: skip
        else:
            place_still(block.planes, reason, with_covariance, posed, pose, returns)
        _weigh(first, planes, block, rules)
        number, odd = _assign(first, size, planes, block, rules[3], found, number, odd)
    return stop, odd, number


@kernel
def point_blocks(
    start: int,
    stop: int,
    odd: int,
    planes: Scalar,
    block: Scalar,
    source: Scalar,
    covariance: F8,
    rules: Scalar,
    found: Scalar,
    number: int,
) -> tuple[int, int, int]:
    """The same for points in the map frame. ``covariance``: (1, 3, 3) for all, or one a point."""
    each = np.int64(1) if len(covariance) > 1 else np.int64(0)
    P = block.planes
    for first in range(start, stop, BLOCK):
        if 2 * (number + BLOCK) > len(found[0]):
            return first, odd, number
        size = min(BLOCK, stop - first)
        read_points(source, first, size, block.planes)
        if rules[0] != POINT:
            for n in range(size):
                c = covariance[(first + n) * each]
                P[S, n] = c[0, 0]
                P[S + 1, n] = c[0, 1]
                P[S + 2, n] = c[0, 2]
                P[S + 3, n] = c[1, 1]
                P[S + 4, n] = c[1, 2]
                P[S + 5, n] = c[2, 2]
        _weigh(first, planes, block, rules)
        number, odd = _assign(first, size, planes, block, rules[3], found, number, odd)
    return stop, odd, number
