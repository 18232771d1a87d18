"""The footprint of a point: its share in each cell that its error body covers (eq. 12)."""

import math

import numpy as np

from roughmap.arrays import F8, I4, Scalar
from roughmap.jit import inline
from roughmap.points.ellipse import ellipse_shares

POINT, CUBOID, ELLIPSOID = 0, 1, 2
ERROR_MODELS = ("point", "cuboid", "ellipsoid")
"""Names of the error models; the index is the number that kernels take."""

LEAST_SHARE = 1e-12
"""Shares up to this are rounding errors of the cell edges and do not count."""


@inline
def _cuboid_shares(
    x: Scalar,
    y: Scalar,
    rx: Scalar,
    ry: Scalar,
    i0: Scalar,
    j0: Scalar,
    ni: Scalar,
    nj: Scalar,
    a: Scalar,
    lines: F8,
    shares: F8,
) -> Scalar:
    """Fill ``shares`` with those of [x-rx, x+rx] x [y-ry, y+ry] in the cells, row by row; return the largest.

    The cell edges are clipped to the footprint, relative to its centre: the shares then add up to 1 without
    normalising.
    """
    widest = 0.0
    before = min(max(i0 * a - x, -rx), rx)
    for i in range(ni):
        after = min(max((i0 + i + 1) * a - x, -rx), rx)
        p = max(after - before, 0.0) / (2.0 * rx)
        lines[4, i] = p
        widest = max(widest, p)
        before = after
    largest = 0.0
    before = min(max(j0 * a - y, -ry), ry)
    for j in range(nj):
        after = min(max((j0 + j + 1) * a - y, -ry), ry)
        p = max(after - before, 0.0) / (2.0 * ry)
        for i in range(ni):
            shares[j * ni + i] = p * lines[4, i]
        largest = max(largest, p * widest)
        before = after
    return largest


@inline
def box_of(boxes: I4, n: Scalar) -> Scalar:
    """Return the cells i0, j0, i1, j1 of row ``n`` as int64."""
    return np.int64(boxes[n, 0]), np.int64(boxes[n, 1]), np.int64(boxes[n, 2]), np.int64(boxes[n, 3])


@inline
def shares_of(model: Scalar, boxes: I4, bodies: F8, n: Scalar, a: Scalar, lines: F8, shares: F8) -> Scalar:
    """Fill ``shares`` with a point's shares in the cells of its footprint, row by row; return the largest.

    Row ``n`` of ``boxes``: cells i0, j0, i1, j1, inclusive. Row ``n`` of ``bodies``: x, y, half extents, rho, beta.
    ``lines`` (5, >= cells along x + 1) is scratch.
    """
    i0, j0, i1, j1 = box_of(boxes, n)
    ni, nj = i1 - i0 + 1, j1 - j0 + 1
    x, y, ex, ey = bodies[n, 0], bodies[n, 1], bodies[n, 2], bodies[n, 3]
    if model == POINT or (ni == 1 and nj == 1):
        shares[0] = 1.0
        return 1.0
    if model == CUBOID:
        largest = _cuboid_shares(x, y, ex, ey, i0, j0, ni, nj, a, lines, shares)
    else:
        largest = ellipse_shares(x, y, ex, ey, bodies[n, 4], bodies[n, 5], i0, j0, ni, nj, a, lines, shares)
    if not largest > LEAST_SHARE:
        # The footprint is finer than float64's spacing at its position: it counts for the cell of the point alone.
        i: Scalar = min(max(np.int64(math.floor(x / a)) - i0, 0), ni - 1)
        j: Scalar = min(max(np.int64(math.floor(y / a)) - j0, 0), nj - 1)
        for c in range(ni * nj):
            shares[c] = 1.0 if c == j * ni + i else 0.0
        largest = 1.0
    return largest
