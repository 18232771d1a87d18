"""Kernels of phase one: the geometry of the points, block by block, up to the tiles in which they lie."""

import math

import numpy as np

from roughmap.arrays import F8, I8, Scalar
from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.integration.drains import RUN
from roughmap.jit import inline, kernel
from roughmap.points.bodies import bound_cuboids, bound_ellipsoids, bound_points
from roughmap.points.footprint import CUBOID, POINT
from roughmap.points.moving import place_moving
from roughmap.points.place import BLOCK, COMMON, MOUNT, UP, S, X, Y, Z, place_still
from roughmap.points.plain import flag_points, weigh_cuboids, weigh_ellipsoids, within
from roughmap.points.propagation import counted_variance
from roughmap.points.strided import read_points
from roughmap.tiles.index import find_or_add, tile_key

BlockState = tuple[int, int, int]
"""Number of tiles found so far, next row of a run, next row of an odd point."""

_MASK = TILE_CELLS - 1


@inline
def _keep_heights(P: F8, part: Scalar, planes: Scalar, ground_only: Scalar) -> None:
    """Keep the heights of a block and what is known of their errors."""
    z, common, mount, up = planes.z[part], planes.common[part], planes.mount[part], planes.up[part]
    some, mounted = np.int64(0), np.int64(0)
    for n in range(BLOCK):
        z[n] = P[Z, n]
    for n in range(BLOCK):
        common[n] = np.float32(counted_variance(P[COMMON, n]))
    for n in range(BLOCK):
        some |= np.int64(P[UP, n] > 0.0)
        mounted |= np.int64(not P[MOUNT, n] <= 0.0)
    for n in range(BLOCK):
        up[n] = np.uint8(0)
    if some and ground_only:
        for n in range(BLOCK):
            up[n] = np.uint8(P[UP, n] > 0.0)
    for n in range(BLOCK):
        mount[n] = np.float32(0.0)
    if mounted:
        for n in range(BLOCK):
            mount[n] = np.float32(math.sqrt(counted_variance(P[MOUNT, n])))


@inline
def _weigh(first: Scalar, planes: Scalar, block: Scalar, rules: Scalar) -> None:
    """Compute the footprints of a block of placed points, and the weights of the plain ones."""
    model, a, area, window, error, min_share, ground_only = rules
    part = slice(first, first + BLOCK)
    reason, q, weight = planes.reason[part], planes.q[part], planes.weight[first // BLOCK]
    P, kept, cells, body, plain = block.planes, block.kept, block.cells, block.body, block.plain
    _keep_heights(P, part, planes, ground_only)
    if model == POINT:
        bound_points(P, reason, cells, a, area)
        flag_points(reason, cells, window, plain)
    elif model == CUBOID:
        bound_cuboids(P, reason, kept, cells, body, q, a, area, error)
        weigh_cuboids(P, reason, cells, body, q, a, window, min_share, weight, plain)
    else:
        bound_ellipsoids(P, reason, kept, cells, body, q, plain, a, area, error)
        weigh_ellipsoids(P, reason, cells, body, q, a, window, min_share, weight, plain)


@inline
def _store_odd(first: Scalar, n: Scalar, planes: Scalar, block: Scalar, odd: Scalar, window: Scalar) -> Scalar:
    """Store what phase two needs of an odd point in row ``odd``; return whether it lies in one tile."""
    cells, body = block.cells, block.body
    for m in range(4):
        planes.odd_box[odd, m] = cells[m, n]
        planes.odd_body[odd, 2 + m] = body[m, n]
    planes.odd_body[odd, 0] = block.planes[X, n]
    planes.odd_body[odd, 1] = block.planes[Y, n]
    planes.odd_tile[odd] = -1 - np.int32(planes.up[first + n])
    return within(cells[0, n], cells[1, n], cells[2, n], cells[3, n], window)


@inline
def _find_tiles(
    first: Scalar, size: Scalar, planes: Scalar, block: Scalar, window: Scalar, found: Scalar, state: Scalar
) -> Scalar:
    """Find the tile of each point of a block, form its runs, and store its odd points.

    ``found`` must have room for a block's tiles. Returns the state after the block.
    """
    table, keys, work, founded, rejected = found
    number, runs, odd = state
    cells = block.cells
    last_key = np.uint64(0)
    row: Scalar = np.int64(-1)
    worked = 0  # consecutive points in this tile
    low = np.uint8(0)  # 1 if one of them can be ground
    length = 0  # of the open run; 0: none is open
    for n in range(size):
        k = first + n
        plain = block.plain[n] != 0
        if not plain:
            if length:
                planes.run_stop[runs - 1] = k
                length = 0
            if planes.reason[k] != 0:
                rejected[planes.reason[k]] += 1
                continue
            alone = _store_odd(first, n, planes, block, odd, window)
            planes.run_start[runs] = k
            planes.run_stop[runs] = k + 1
            planes.run_tile[runs] = -1 - odd
            runs += 1
            odd += 1
            if not alone:
                continue
        i, j = cells[0, n], cells[1, n]
        key = tile_key(i >> TILE_SHIFT, j >> TILE_SHIFT)
        if row < 0 or key != last_key:
            if worked:
                work[row] += worked
                founded[row] |= low
                worked = 0
                low = np.uint8(0)
            if length:
                planes.run_stop[runs - 1] = k
                length = 0
            last_key = key
            row, number = find_or_add(table, keys, work, key, number)
        worked += 1
        low |= planes.up[k] ^ np.uint8(1)
        if not plain:
            planes.odd_tile[odd - 1] = row
            continue
        planes.corner[k] = (j & _MASK) << TILE_SHIFT | (i & _MASK)
        if length == RUN:
            planes.run_stop[runs - 1] = k
            length = 0
        if length == 0:
            planes.run_start[runs] = k
            planes.run_tile[runs] = row
            runs += 1
        length += 1
    if length:
        planes.run_stop[runs - 1] = first + size
    if worked:
        work[row] += worked
        founded[row] |= low
    return number, runs, odd


@kernel
def scan_blocks(
    start: int,
    stop: int,
    planes: Scalar,
    block: Scalar,
    source: Scalar,
    offsets: I8,
    moving: bool,
    stamp: int,
    path: Scalar,
    max_gap_ns: float,
    posed: bool,
    pose: Scalar,
    returns: Scalar,
    rules: Scalar,
    clear: bool,
    found: Scalar,
    state: BlockState,
) -> tuple[int, BlockState]:
    """Place the points ``start`` to ``stop`` of a scan, compute their footprints and weights, and find their tiles.

    ``start`` is the first point of a block. ``returns``: see `scan_rules`; ``rules``: see `MapSettings.rules`.
    ``clear``: keep x and y of all points. Stops early if the table of tiles in ``found`` has no room for another block.
    Returns the point at which it stopped and the `BlockState` there.
    """
    for first in range(start, stop, BLOCK):
        if 2 * (state[0] + BLOCK) > len(found[0]):
            return first, state
        size = min(BLOCK, stop - first)
        reason = planes.reason[first : first + BLOCK]
        read_points(source, first, size, block.planes)
        with_covariance = rules[0] != POINT
        if moving:
            place_moving(
                block.planes, reason, offsets, first, size, block.moving, with_covariance, stamp, path,
                max_gap_ns, returns,
            )  # fmt: skip
        else:
            place_still(block.planes, reason, with_covariance, posed, pose, returns)
        if clear:
            for n in range(BLOCK):
                planes.x[first + n] = block.planes[X, n]
                planes.y[first + n] = block.planes[Y, n]
        _weigh(first, planes, block, rules)
        state = _find_tiles(first, size, planes, block, rules[3], found, state)
    return stop, state


@kernel
def point_blocks(
    start: int,
    stop: int,
    planes: Scalar,
    block: Scalar,
    source: Scalar,
    covariance: F8,
    shared: Scalar,
    rules: Scalar,
    found: Scalar,
    state: BlockState,
) -> tuple[int, BlockState]:
    """Do the same for points in the map frame.

    ``covariance``: (1, 3, 3) for all points, or (N, 3, 3). ``shared``: common, mount and up, (1,) or (N,) each.
    """
    each = np.int64(1) if len(covariance) > 1 else np.int64(0)
    common, mount, up = shared
    P = block.planes
    for first in range(start, stop, BLOCK):
        if 2 * (state[0] + BLOCK) > len(found[0]):
            return first, state
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
        for n in range(size):
            P[COMMON, n] = common[first + n if len(common) > 1 else 0]
            P[MOUNT, n] = mount[first + n if len(mount) > 1 else 0]
            P[UP, n] = 1.0 if up[first + n if len(up) > 1 else 0] else 0.0
        _weigh(first, planes, block, rules)
        state = _find_tiles(first, size, planes, block, rules[3], found, state)
    return stop, state
