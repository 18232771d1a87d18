"""Geometry of many points, block after block: from a scan, or from points that are placed already."""

import numpy as np

from roughmap.arrays import F8, I4, I8, U1, Scalar
from roughmap.footprint import CUBOID, POINT, bound_cuboids, bound_ellipsoids, bound_points
from roughmap.jit import inline, kernel
from roughmap.place import BLOCK, place_moving, place_still


@inline
def _bound(
    model: Scalar, x: F8, y: F8, z: F8, S: F8, reason: U1, cells: I4, body: F8, a: Scalar, area: Scalar, error: Scalar
) -> None:
    if model == POINT:
        bound_points(x, y, z, reason, cells, a, area)
    elif model == CUBOID:
        bound_cuboids(x, y, z, S, reason, cells, body, a, area, error)
    else:
        bound_ellipsoids(x, y, z, S, reason, cells, body, a, area, error)


@kernel
def scan_blocks(
    start: int,
    stop: int,
    model: int,
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    cells: I4,
    body: F8,
    levers: F8,
    S: F8,
    bracket: I8,
    moving: bool,
    offsets: I8,
    stamp: int,
    way: Scalar,
    max_gap_ns: float,
    posed: bool,
    pose: Scalar,
    rules: Scalar,
    a: float,
    area: Scalar,
    error: Scalar,
) -> None:
    """Place and bound the points of a scan from ``start``, where a block begins, to ``stop``.

    The covariances live only as long as their block.
    """
    for first in range(start, stop, BLOCK):
        last = min(first + BLOCK, stop)
        bx, by, bz, why = x[first:last], y[first:last], z[first:last], reason[first:last]
        if moving:
            place_moving(
                bx, by, bz, why, offsets[first:last], bracket, levers, S, model != POINT, stamp, way, max_gap_ns, rules
            )
        else:
            place_still(bx, by, bz, why, levers, S, model != POINT, posed, pose, rules)
        _bound(model, bx, by, bz, S, why, cells[first // BLOCK], body[first // BLOCK], a, area, error)


@kernel
def point_blocks(
    start: int,
    stop: int,
    model: int,
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    cells: I4,
    body: F8,
    S: F8,
    covariance: F8,
    a: float,
    area: Scalar,
    error: Scalar,
) -> None:
    """Bound points in the map frame from ``start``, where a block begins, to ``stop``.

    ``covariance``: (1, 3, 3) for all, or one a point.
    """
    each = np.int64(1) if len(covariance) > 1 else np.int64(0)
    for first in range(start, stop, BLOCK):
        last = min(first + BLOCK, stop)
        if model != POINT:
            for n in range(last - first):
                c = covariance[(first + n) * each]
                S[0, n] = c[0, 0]
                S[1, n] = c[0, 1]
                S[2, n] = c[0, 2]
                S[3, n] = c[1, 1]
                S[4, n] = c[1, 2]
                S[5, n] = c[2, 2]
        _bound(
            model,
            x[first:last],
            y[first:last],
            z[first:last],
            S,
            reason[first:last],
            cells[first // BLOCK],
            body[first // BLOCK],
            a,
            area,
            error,
        )
