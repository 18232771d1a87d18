"""The error bodies of a block of points: checks on their covariances, their extents, and the cells that they cover.

Footprints are found without the divisions that `doubt` can spare, and once more the exact way for a block in which the
answer for any accepted point was in doubt.
"""

import math

import numpy as np

from roughmap.arrays import F8, I4, U1, Scalar
from roughmap.cell import PointReason
from roughmap.jit import inline
from roughmap.points.doubt import is_floor_in_doubt, is_surely_covariance
from roughmap.points.ellipse import pivots, raise_eigenvalues
from roughmap.points.place import BLOCK, S, X, Y, Z

_NOT_FINITE = int(PointReason.NOT_FINITE)
_COVARIANCE = int(PointReason.COVARIANCE)
_UNCERTAIN = int(PointReason.UNCERTAIN)
_BOUNDS = int(PointReason.BOUNDS)

_INT_MIN = -2147483648.0
_INT_MAX = 2147483647.0
_PSD_SLACK = 1e-9
"""How far below zero an eigenvalue may lie, as a fraction of the trace."""

HEIGHT_MAX = 1e150
"""Metres. Greater heights, up or down, are out of bounds, because their squares would overflow."""

GROUND_HEIGHT_MAX = 1e7
"""The same where cells have columns, whose bins are numbered in 32 bits."""

_DENSITY_MIN, _DENSITY_MAX = 1e-140, 1e140
"""Range of weight per share in which W and W2 neither overflow nor underflow."""


@inline
def is_covariance(xx: Scalar, xy: Scalar, xz: Scalar, yy: Scalar, yz: Scalar, zz: Scalar) -> Scalar:
    """Whether the matrix is finite, with no negative diagonal entry and no eigenvalue below -1e-9 times the trace."""
    finite = (
        (abs(xx) < math.inf)
        & (abs(xy) < math.inf)
        & (abs(xz) < math.inf)
        & (abs(yy) < math.inf)
        & (abs(yz) < math.inf)
        & (abs(zz) < math.inf)
    )
    trace = xx + yy + zz
    # Dividing by the trace avoids overflow and underflow. Pivots instead of minors: for a matrix of rank one the minors
    # are lost in rounding, the pivots stay near the slack.
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
def _position_reason(
    before: Scalar, x: Scalar, y: Scalar, z: Scalar, f0: Scalar, f1: Scalar, g0: Scalar, g1: Scalar, area: Scalar
) -> Scalar:
    """Return ``not_finite``, else the reason ``before``, else ``bounds``. f, g: first and last cell along x and y."""
    inside = (
        (x >= area[0])
        & (y >= area[1])
        & (x < area[2])
        & (y < area[3])
        & (f0 >= _INT_MIN)
        & (g0 >= _INT_MIN)
        & (f1 <= _INT_MAX)
        & (g1 <= _INT_MAX)
        & (abs(z) <= area[4])
    )
    reason = np.uint8(_BOUNDS) if (before == 0) & (not inside) else np.uint8(before)
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else np.uint8(_NOT_FINITE)


@inline
def _cell_number(f: Scalar) -> Scalar:
    """Convert a floored number to int32; 0 if it does not fit, since that point is rejected anyway."""
    return np.int32(f if (f >= _INT_MIN) & (f <= _INT_MAX) else 0.0)


@inline
def bound_points(planes: F8, reason: U1, cells: I4, a: float, area: Scalar) -> None:
    """`point`: find the cell of each point. ``cells`` (4, BLOCK): i0, j0, i1, j1 of the footprint, inclusive.

    Always the exact way: two divisions cost less than their doubts.
    """
    for n in range(BLOCK):
        x, y, z = planes[X, n], planes[Y, n], planes[Z, n]
        f = math.floor(x / a) + 0.0
        g = math.floor(y / a) + 0.0
        before = reason[n]
        judged = _position_reason(before, x, y, z, f, f, g, g, area)
        reason[n] = judged if before == 0 else before
        i = _cell_number(f)
        j = _cell_number(g)
        cells[0, n] = i
        cells[1, n] = j
        cells[2, n] = i
        cells[3, n] = j


@inline
def _restore(reason: U1, kept: U1) -> None:
    for n in range(BLOCK):
        reason[n] = kept[n]


@inline
def _keep(reason: U1, kept: U1) -> None:
    for n in range(BLOCK):
        kept[n] = reason[n]


@inline
def _bound(
    n: Scalar, planes: F8, reason: U1, cells: I4, ex: Scalar, ey: Scalar, before: Scalar, a: Scalar, area: Scalar,
    exact: Scalar,
) -> Scalar:  # fmt: skip
    """Set cells and reason of a point with half extents ex, ey; ``before``: the reason from its covariance, or 0.

    Returns whether its cells are in doubt.
    """
    x, y, z = planes[X, n], planes[Y, n], planes[Z, n]
    inverse = 1.0 / a
    west = (x - ex) / a if exact else (x - ex) * inverse
    south = (y - ey) / a if exact else (y - ey) * inverse
    east = (x + ex) / a if exact else (x + ex) * inverse
    north = (y + ey) / a if exact else (y + ey) * inverse
    f0, g0, f1, g1 = np.floor(west), np.floor(south), np.floor(east), np.floor(north)
    earlier = reason[n]
    judged = _position_reason(before, x, y, z, f0, f1, g0, g1, area)
    reason[n] = judged if earlier == 0 else earlier
    cells[0, n] = _cell_number(f0)
    cells[1, n] = _cell_number(g0)
    cells[2, n] = _cell_number(f1)
    cells[3, n] = _cell_number(g1)
    return (is_floor_in_doubt(west) | is_floor_in_doubt(south) | is_floor_in_doubt(east) | is_floor_in_doubt(north)) & (
        earlier == 0
    )


@inline
def _covariance(planes: F8, n: Scalar) -> Scalar:
    """Return the upper triangle of a point's covariance."""
    return planes[S, n], planes[S + 1, n], planes[S + 2, n], planes[S + 3, n], planes[S + 4, n], planes[S + 5, n]


@inline
def _covariance_reason(good: Scalar, wide: Scalar) -> Scalar:
    """Return the reason to reject a covariance, or 0."""
    before = np.uint8(_UNCERTAIN) if wide else np.uint8(0)
    return before if good else np.uint8(_COVARIANCE)


@inline
def bound_cuboids(
    planes: F8, reason: U1, kept: U1, cells: I4, body: F8, q: F8, a: float, area: Scalar, error: Scalar
) -> None:
    """`cuboid`: for one block, set cells, reasons, ``body`` (>= 2, BLOCK): rx, ry, and ``q`` = w / p = a / (rx ry rz).

    ``planes``: see `place`. ``area``: xmin, ymin, xmax, ymax, half-open, and the largest height, up or down, metres.
    ``error``: coverage, min_radius, max_horizontal_radius, max_vertical_sigma. Points that already have a reason keep
    it. ``kept`` (BLOCK,) is scratch.
    """
    _keep(reason, kept)
    if _bound_cuboids(planes, reason, cells, body, q, a, area, error, False):
        _restore(reason, kept)
        _bound_cuboids(planes, reason, cells, body, q, a, area, error, True)


@inline
def _bound_cuboids(
    planes: F8, reason: U1, cells: I4, body: F8, q: F8, a: float, area: Scalar, error: Scalar, exact: Scalar
) -> Scalar:
    k, least, widest, tallest = error
    doubts = np.int64(0)
    for n in range(BLOCK):
        xx, xy, xz, yy, yz, zz = _covariance(planes, n)
        sx = k * math.sqrt(xx)
        sy = k * math.sqrt(yy)
        rx = max(sx, least)
        ry = max(sy, least)
        rz = max(k * math.sqrt(zz), least)
        density = a / (rx * ry * rz)
        sure = is_covariance(xx, xy, xz, yy, yz, zz) if exact else is_surely_covariance(xx, xy, xz, yy, yz, zz)
        good = sure & (density > _DENSITY_MIN) & (density < _DENSITY_MAX)
        before = _covariance_reason(good, (max(sx, sy) > widest) | (zz > tallest * tallest))
        doubt = (not sure) & (reason[n] == 0)
        doubt |= _bound(n, planes, reason, cells, rx, ry, before, a, area, exact)
        body[0, n] = rx
        body[1, n] = ry
        q[n] = density
        doubts += np.int64(1) if doubt else np.int64(0)
    return doubts != 0


@inline
def bound_ellipsoids(
    planes: F8, reason: U1, kept: U1, cells: I4, body: F8, q: F8, judged: U1, a: float, area: Scalar, error: Scalar
) -> None:
    """`ellipsoid`: as `bound_cuboids`, with ``body``: k sx, k sy, rho, beta, and ``q`` = a / (k^3 sqrt(det S)).

    Eigenvalues below (min_radius / k)^2 are raised to it in ``planes``. ``judged`` (BLOCK,) is scratch too.
    """
    doubt, thin = _judge_ellipsoids(planes, reason, q, judged, error, False)
    if doubt:
        _, thin = _judge_ellipsoids(planes, reason, q, judged, error, True)
    k, least, _, _ = error
    if thin:
        for n in range(BLOCK):
            if q[n] == -1.0 and judged[n] != _COVARIANCE and reason[n] == 0:
                q[n] = raise_eigenvalues(planes, S, n, (least / k) * (least / k))
    for n in range(BLOCK):
        q[n] = a / (k * k * k * math.sqrt(q[n]))
    _keep(reason, kept)
    if _bound_ellipsoids(planes, reason, cells, body, q, judged, a, area, error, False):
        _restore(reason, kept)
        _bound_ellipsoids(planes, reason, cells, body, q, judged, a, area, error, True)


@inline
def _judge_ellipsoids(planes: F8, reason: U1, q: F8, judged: U1, error: Scalar, exact: Scalar) -> Scalar:
    """Set ``judged`` to the reasons from the covariances, and ``q`` to their determinants, -1 where an eigenvalue is
    below (min_radius / k)^2.

    Returns whether an answer is in doubt, and whether there is such an eigenvalue.
    """
    k, least, widest, tallest = error
    floor = (least / k) * (least / k)
    doubts, thin = np.int64(0), np.int64(0)
    for n in range(BLOCK):
        xx, xy, xz, yy, yz, zz = _covariance(planes, n)
        good = is_covariance(xx, xy, xz, yy, yz, zz) if exact else is_surely_covariance(xx, xy, xz, yy, yz, zz)
        judged[n] = _covariance_reason(good, (k * math.sqrt(max(xx, yy)) > widest) | (zz > tallest * tallest))
        doubts += np.int64(1) if (not good) & (reason[n] == 0) else np.int64(0)
        d0, d1, d2 = pivots(xx, xy, xz, yy, yz, zz)
        m0, m1, m2 = pivots(xx - floor, xy, xz, yy - floor, yz, zz - floor)
        thick = (m0 > 0.0) & (m1 > 0.0) & (m2 > 0.0)
        q[n] = d0 * d1 * d2 if thick else -1.0
        thin += np.int64(0) if thick else np.int64(1)
    return doubts != 0, thin != 0


@inline
def _bound_ellipsoids(
    planes: F8, reason: U1, cells: I4, body: F8, q: F8, judged: U1, a: float, area: Scalar, error: Scalar,
    exact: Scalar,
) -> Scalar:  # fmt: skip
    k, least, widest, _ = error
    # Raising an eigenvalue slightly below zero may widen a very high body without limit, since the slack is relative to
    # the trace. ``room`` is the largest extent of any other body, and the scratch for footprints is sized for it.
    room = math.sqrt(widest * widest + least * least) * (1.0 + 1e-9)
    doubts = np.int64(0)
    for n in range(BLOCK):
        xx, xy, _, yy, _, _ = _covariance(planes, n)
        ex = k * math.sqrt(xx)
        ey = k * math.sqrt(yy)
        good = (q[n] > _DENSITY_MIN) & (q[n] < _DENSITY_MAX) & ((max(ex, ey) <= room) | (judged[n] != 0))
        before = judged[n] if good else np.uint8(_COVARIANCE)
        doubt = _bound(n, planes, reason, cells, ex, ey, before, a, area, exact)
        product = xx * yy
        body[0, n] = ex
        body[1, n] = ey
        body[2, n] = xy / math.sqrt(product)
        body[3, n] = math.sqrt(max(product - xy * xy, 0.0) / product)
        doubts += np.int64(1) if doubt else np.int64(0)
    return doubts != 0
