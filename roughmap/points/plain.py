"""Weights of plain points (eq. 12, 14): footprints of at most 2 x 2 cells of one tile, computed without branches."""

import numpy as np

from roughmap.arrays import F8, I4, U1, Scalar
from roughmap.cell import TILE_SHIFT
from roughmap.jit import inline
from roughmap.points.ellipse import corner_share, half_chord, half_plane
from roughmap.points.footprint import LEAST_SHARE
from roughmap.points.place import BLOCK, X, Y
from roughmap.points.poly import angle

_SHIFT = np.int32(TILE_SHIFT)


@inline
def within(i0: Scalar, j0: Scalar, i1: Scalar, j1: Scalar, window: Scalar) -> Scalar:
    """Whether the whole footprint lies in one tile and in the map's ``window``."""
    inside = (i0 >= window[0]) & (j0 >= window[1]) & (i1 <= window[2]) & (j1 <= window[3])
    return inside & (((i0 ^ i1) | (j0 ^ j1)) >> _SHIFT == 0)


@inline
def _is_plain(i0: Scalar, j0: Scalar, i1: Scalar, j1: Scalar, window: Scalar) -> Scalar:
    return within(i0, j0, i1, j1, window) & (i0 >= i1 - 1) & (j0 >= j1 - 1)


@inline
def _weight(p: Scalar, least: Scalar, q: Scalar) -> Scalar:
    """Return the weight of a share, 0 where the share is too small to count."""
    return p * q if (p >= least) & (p > LEAST_SHARE) else 0.0


@inline
def _store_weights(
    n: Scalar, p0: Scalar, p1: Scalar, p2: Scalar, p3: Scalar, one: Scalar, plain: Scalar, min_share: Scalar, q: F8,
    weight: F8, flags: U1,
) -> None:  # fmt: skip
    """Store the weights of a point's four cells, that of the largest share negative; ``one``: the footprint is a
    single cell."""
    p0 = 1.0 if one else p0
    p1 = 0.0 if one else p1
    p2 = 0.0 if one else p2
    p3 = 0.0 if one else p3
    largest = max(max(p0, p1), max(p2, p3))  # noqa: PLW3301 - in pairs: two dependent steps instead of three
    least = min_share * largest
    w0, w1 = _weight(p0, least, q[n]), _weight(p1, least, q[n])
    w2, w3 = _weight(p2, least, q[n]), _weight(p3, least, q[n])
    # The first of equal shares, row by row.
    in0 = p0 == largest
    in1 = (p1 == largest) & (not in0)
    in2 = (p2 == largest) & (max(p0, p1) < largest)
    in3 = max(max(p0, p1), p2) < largest  # noqa: PLW3301 - as above
    weight[0, n] = -w0 if in0 else w0
    weight[1, n] = -w1 if in1 else w1
    weight[2, n] = -w2 if in2 else w2
    weight[3, n] = -w3 if in3 else w3
    # A footprint finer than float64's spacing at its position is handled as an odd point.
    flags[n] = np.uint8(1) if plain & (largest > LEAST_SHARE) else np.uint8(0)


@inline
def flag_points(reason: U1, cells: I4, window: Scalar, plain: U1) -> None:
    """`point`: set ``plain`` to 1 for accepted points in the ``window``; their weight is 1."""
    for n in range(BLOCK):
        inside = _is_plain(cells[0, n], cells[1, n], cells[2, n], cells[3, n], window)
        plain[n] = np.uint8(1) if inside & (reason[n] == 0) else np.uint8(0)


@inline
def _overlap(low: Scalar, high: Scalar, radius: Scalar) -> Scalar:
    return max(high - low, 0.0) / (2.0 * radius)


@inline
def weigh_cuboids(
    planes: F8, reason: U1, cells: I4, body: F8, q: F8, a: float, window: Scalar, min_share: float, weight: F8,
    plain: U1,
) -> None:  # fmt: skip
    """`cuboid`: compute ``weight`` (4, BLOCK) for one block and set ``plain`` to 1 for plain points."""
    for n in range(BLOCK):
        i0, j0, i1, j1 = cells[0, n], cells[1, n], cells[2, n], cells[3, n]
        x, y, rx, ry = planes[X, n], planes[Y, n], body[0, n], body[1, n]
        i, j = float(i0), float(j0)
        # Clip the cell edges to the footprint, relative to its centre: the shares then add up to 1 without normalising.
        west = min(max(i * a - x, -rx), rx)
        middle = min(max((i + 1.0) * a - x, -rx), rx)
        east = min(max((i + 2.0) * a - x, -rx), rx)
        south = min(max(j * a - y, -ry), ry)
        centre = min(max((j + 1.0) * a - y, -ry), ry)
        north = min(max((j + 2.0) * a - y, -ry), ry)
        left, right = _overlap(west, middle, rx), _overlap(middle, east, rx)
        below, above = _overlap(south, centre, ry), _overlap(centre, north, ry)
        one = (i0 == i1) & (j0 == j1)
        fits = _is_plain(i0, j0, i1, j1, window) & (reason[n] == 0)
        _store_weights(
            n, below * left, below * right, above * left, above * right, one, fits, min_share, q, weight, plain
        )


@inline
def weigh_ellipsoids(
    planes: F8, reason: U1, cells: I4, body: F8, q: F8, a: float, window: Scalar, min_share: float, weight: F8,
    plain: U1,
) -> None:  # fmt: skip
    """`ellipsoid`: as `weigh_cuboids`. Only the two middle cell edges can cross the ellipse."""
    for n in range(BLOCK):
        i0, j0, i1, j1 = cells[0, n], cells[1, n], cells[2, n], cells[3, n]
        x, y, rho, beta = planes[X, n], planes[Y, n], body[2, n], body[3, n]
        U = 1.0 if i0 == i1 else ((float(i0) + 1.0) * a - x) / body[0, n]
        V = 1.0 if j0 == j1 else ((float(j0) + 1.0) * a - y) / body[1, n]
        su, sv = half_chord(U), half_chord(V)
        arc_u, arc_v = angle(U, su), angle(V, sv)
        left, below = half_plane(U, su, arc_u), half_plane(V, sv, arc_v)
        both = corner_share(U, su, arc_u, left, V, sv, arc_v, below, rho, beta, angle(rho, beta))
        one = (i0 == i1) & (j0 == j1)
        fits = _is_plain(i0, j0, i1, j1, window) & (reason[n] == 0)
        _store_weights(
            n, max(both, 0.0), max(below - both, 0.0), max(left - both, 0.0), max((1.0 - left) - (below - both), 0.0),
            one, fits, min_share, q, weight, plain,
        )  # fmt: skip
