"""Where a point may be: the bounds of its error body, the tests on its covariance, its shares in cells (eq. 12)."""

import math

import numpy as np

from roughmap.arrays import F8, I4, U1, Scalar
from roughmap.cell import PointReason
from roughmap.ellipse import ellipse_shares, pivots, raise_eigenvalues
from roughmap.jit import inline, kernel

POINT, CUBOID, ELLIPSOID = 0, 1, 2
ERROR_MODELS = ("point", "cuboid", "ellipsoid")
"""The names of the models; index = the number that kernels take."""

LEAST_SHARE = 1e-12
"""A share must be above this to take part: below it the rounding of edges is all that it says."""

_NOT_FINITE = int(PointReason.NOT_FINITE)
_COVARIANCE = int(PointReason.COVARIANCE)
_UNCERTAIN = int(PointReason.UNCERTAIN)
_BOUNDS = int(PointReason.BOUNDS)

_INT_MIN = -2147483648.0
_INT_MAX = 2147483647.0
_PSD_SLACK = 1e-9
"""An eigenvalue may be this far below zero, in parts of the trace."""

_DENSITY_MIN, _DENSITY_MAX = 1e-140, 1e140
"""Weights per share within which W and W2 neither over- nor underflow."""


@inline
def _judge_covariance(xx: Scalar, xy: Scalar, xz: Scalar, yy: Scalar, yz: Scalar, zz: Scalar) -> Scalar:
    """Whether a covariance is finite, without a negative diagonal, and without an eigenvalue < -1e-9 trace."""
    finite = (
        (abs(xx) < math.inf)
        & (abs(xy) < math.inf)
        & (abs(xz) < math.inf)
        & (abs(yy) < math.inf)
        & (abs(yz) < math.inf)
        & (abs(zz) < math.inf)
    )
    trace = xx + yy + zz
    # In parts of the trace nothing over- or underflows. Pivots, not minors: those of a matrix of rank one drown in
    # rounding, these stay at the slack.
    d0, d1, d2 = pivots(
        xx / trace + _PSD_SLACK,
        xy / trace,
        xz / trace,
        yy / trace + _PSD_SLACK,
        yz / trace,
        zz / trace + _PSD_SLACK,
    )
    psd = (d0 > 0.0) & (d1 > 0.0) & (d2 > 0.0)
    exact = (trace == 0.0) & (xy == 0.0) & (xz == 0.0) & (yz == 0.0)
    return finite & (xx >= 0.0) & (yy >= 0.0) & (zz >= 0.0) & (psd | exact)


@inline
def _judge_place(
    before: Scalar, x: Scalar, y: Scalar, z: Scalar, f0: Scalar, f1: Scalar, g0: Scalar, g1: Scalar, area: Scalar
) -> Scalar:
    """The reason ``before``, or ``bounds``; before both ``not_finite``. f, g: first and last cell along x and y."""
    inside = (
        (x >= area[0])
        & (y >= area[1])
        & (x < area[2])
        & (y < area[3])
        & (f0 >= _INT_MIN)
        & (g0 >= _INT_MIN)
        & (f1 <= _INT_MAX)
        & (g1 <= _INT_MAX)
    )
    reason = np.uint8(_BOUNDS) if (before == 0) & (not inside) else np.uint8(before)
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else np.uint8(_NOT_FINITE)


@inline
def _cell_number(f: Scalar) -> Scalar:
    """A floored number as int32; 0 for one that does not fit, whose point is rejected anyway."""
    return np.int32(f if (f >= _INT_MIN) & (f <= _INT_MAX) else 0.0)


@kernel
def bound_points(x: F8, y: F8, z: F8, reason: U1, cells: I4, a: float, area: Scalar) -> None:
    """`point`: the cell of each point. ``cells`` (4, BLOCK): i0, j0, i1, j1 of the footprint, both ends in it."""
    for n in range(len(x)):
        f = math.floor(x[n] / a) + 0.0
        g = math.floor(y[n] / a) + 0.0
        before = reason[n]
        judged = _judge_place(before, x[n], y[n], z[n], f, f, g, g, area)
        reason[n] = judged if before == 0 else before
        i = _cell_number(f)
        j = _cell_number(g)
        cells[0, n] = i
        cells[1, n] = j
        cells[2, n] = i
        cells[3, n] = j


@inline
def _bound(
    n: Scalar, x: F8, y: F8, z: F8, reason: U1, cells: I4, ex: Scalar, ey: Scalar, good: Scalar, wide: Scalar,
    a: Scalar, area: Scalar,
) -> None:  # fmt: skip
    """Cells and reason of a point with half extents ex, ey."""
    f0 = np.floor((x[n] - ex) / a)
    g0 = np.floor((y[n] - ey) / a)
    f1 = np.floor((x[n] + ex) / a)
    g1 = np.floor((y[n] + ey) / a)
    earlier = reason[n]
    before = np.uint8(_UNCERTAIN) if wide else np.uint8(0)
    before = before if good else np.uint8(_COVARIANCE)
    judged = _judge_place(before, x[n], y[n], z[n], f0, f1, g0, g1, area)
    reason[n] = judged if earlier == 0 else earlier
    cells[0, n] = _cell_number(f0)
    cells[1, n] = _cell_number(g0)
    cells[2, n] = _cell_number(f1)
    cells[3, n] = _cell_number(g1)


@kernel
def bound_cuboids(
    x: F8, y: F8, z: F8, S: F8, reason: U1, cells: I4, body: F8, a: float, area: Scalar, error: Scalar
) -> None:
    """`cuboid`, a block: cells, reasons, and ``body`` (5, BLOCK): rx, ry, q = w / p = a / (rx ry rz).

    ``S`` (6, >= n): upper triangles. ``area``: xmin, ymin, xmax, ymax, half-open, metres. ``error``: coverage,
    min_radius, max_horizontal_radius. Points that have a reason keep it.
    """
    k, least, widest = error
    for n in range(len(x)):
        xx, yy, zz = S[0, n], S[3, n], S[5, n]
        sx = k * math.sqrt(xx)
        sy = k * math.sqrt(yy)
        rx = max(sx, least)
        ry = max(sy, least)
        rz = max(k * math.sqrt(zz), least)
        q = a / (rx * ry * rz)
        good = _judge_covariance(xx, S[1, n], S[2, n], yy, S[4, n], zz) & (q > _DENSITY_MIN) & (q < _DENSITY_MAX)
        _bound(n, x, y, z, reason, cells, rx, ry, good, max(sx, sy) > widest, a, area)
        body[0, n] = rx
        body[1, n] = ry
        body[2, n] = q


@kernel
def bound_ellipsoids(
    x: F8, y: F8, z: F8, S: F8, reason: U1, cells: I4, body: F8, a: float, area: Scalar, error: Scalar
) -> None:
    """`ellipsoid`, a block: as `bound_cuboids`, with ``body``: k sx, k sy, q = a / (k^3 sqrt(det S)), rho, beta.

    Where an eigenvalue is below (min_radius / k)^2 it is raised to it in ``S``, in place.
    """
    k, least, widest = error
    floor = (least / k) * (least / k)
    for n in range(len(x)):
        xx, xy, xz, yy, yz, zz = S[0, n], S[1, n], S[2, n], S[3, n], S[4, n], S[5, n]
        good = _judge_covariance(xx, xy, xz, yy, yz, zz)
        wide = k * math.sqrt(max(xx, yy)) > widest
        d0, d1, d2 = pivots(xx, xy, xz, yy, yz, zz)
        det = d0 * d1 * d2
        m0, m1, m2 = pivots(xx - floor, xy, xz, yy - floor, yz, zz - floor)
        thin = not ((m0 > 0.0) & (m1 > 0.0) & (m2 > 0.0))
        if thin and good and reason[n] == 0:
            det = raise_eigenvalues(S, n, floor)
            xx, xy, yy = S[0, n], S[1, n], S[3, n]
        ex = k * math.sqrt(xx)
        ey = k * math.sqrt(yy)
        q = a / (k * k * k * math.sqrt(det))
        good = good & (q > _DENSITY_MIN) & (q < _DENSITY_MAX)
        _bound(n, x, y, z, reason, cells, ex, ey, good, wide, a, area)
        product = xx * yy
        body[0, n] = ex
        body[1, n] = ey
        body[2, n] = q
        body[3, n] = xy / math.sqrt(product)
        body[4, n] = math.sqrt(max(product - xy * xy, 0.0) / product)


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
    row: F8,
    shares: F8,
) -> Scalar:
    """Shares of [x-rx, x+rx] x [y-ry, y+ry] in the cells, row by row; the largest.

    The edges are cut to the footprint relative to its middle, so that the shares add up to 1 by themselves.
    """
    widest = 0.0
    before = min(max(i0 * a - x, -rx), rx)
    for i in range(ni):
        after = min(max((i0 + i + 1) * a - x, -rx), rx)
        p = max(after - before, 0.0) / (2.0 * rx)
        row[i] = p
        widest = max(widest, p)
        before = after
    largest = 0.0
    before = min(max(j0 * a - y, -ry), ry)
    for j in range(nj):
        after = min(max((j0 + j + 1) * a - y, -ry), ry)
        p = max(after - before, 0.0) / (2.0 * ry)
        for i in range(ni):
            shares[j * ni + i] = p * row[i]
        largest = max(largest, p * widest)
        before = after
    return largest


@kernel
def shares_of(model: int, n: int, x: float, y: float, cells: I4, body: F8, a: float, lines: F8, shares: F8) -> Scalar:
    """Fill ``shares`` with the shares of point ``n`` of a block in the cells of its footprint, row by row; the largest.

    (x, y): its place. ``lines`` (5, >= cells along x + 1) is scratch.
    """
    i0, j0 = np.int64(cells[0, n]), np.int64(cells[1, n])
    ni = np.int64(cells[2, n]) - i0 + 1
    nj = np.int64(cells[3, n]) - j0 + 1
    if ni == 1 and nj == 1:
        shares[0] = 1.0
        return 1.0
    if model == CUBOID:
        largest = _cuboid_shares(x, y, body[0, n], body[1, n], i0, j0, ni, nj, a, lines[4], shares)
    else:
        largest = ellipse_shares(
            x, y, body[0, n], body[1, n], body[3, n], body[4, n], i0, j0, ni, nj, a, lines, lines[4], shares
        )
    if not largest > LEAST_SHARE:
        # The footprint is finer than float64's spacing at its place: all of it lies in the cell of its position.
        i: Scalar = min(max(np.int64(math.floor(x / a)) - i0, 0), ni - 1)
        j: Scalar = min(max(np.int64(math.floor(y / a)) - j0, 0), nj - 1)
        shares[: ni * nj] = 0.0
        shares[j * ni + i] = 1.0
        largest = 1.0
    return largest
