"""The ellipsoid model: raising small eigenvalues, and the exact share of an ellipse in each cell.

The ellipse x^T C^-1 x <= k^2 maps to the unit disk by u = (X - x) / (k sx) and w = (Y - y) / (k sy): a line along y
becomes u = U, a line along x becomes rho u + beta v = V with beta = sqrt(1 - rho^2). The area of the disk to the left
of the first and below the second has a closed form. A cell's share is a difference of four such areas, so that the
shares add up to 1, however thin the ellipse.
"""

import math

from roughmap.arrays import F8, Scalar
from roughmap.jit import inline, kernel
from roughmap.points.poly import angle

_SWEEPS = 16
"""Upper limit. Jacobi's method converges quadratically: a 3x3 matrix needs five or six sweeps."""


@inline
def pivots(a: Scalar, b: Scalar, c: Scalar, d: Scalar, e: Scalar, f: Scalar) -> Scalar:
    """Return the L D L^T pivots of [[a, b, c], [b, d, e], [c, e, f]]; all > 0 if and only if positive definite."""
    second = d - b * b / a
    corner = e - b * c / a
    return a, second, f - c * c / a - corner * corner / second


@kernel
def raise_eigenvalues(planes: F8, first: int, n: int, least: float) -> Scalar:
    """Raise the eigenvalues below ``least`` of the matrix in planes[first :, n] (upper triangle).

    Returns the determinant. A matrix without such eigenvalues is not changed. Cyclic Jacobi rotations, which need no
    function but ``sqrt``.
    """
    a00, a01, a02 = planes[first, n], planes[first + 1, n], planes[first + 2, n]
    a11, a12, a22 = planes[first + 3, n], planes[first + 4, n], planes[first + 5, n]
    v00, v01, v02 = 1.0, 0.0, 0.0
    v10, v11, v12 = 0.0, 1.0, 0.0
    v20, v21, v22 = 0.0, 0.0, 1.0
    for _ in range(_SWEEPS):
        if a01 == 0.0 and a02 == 0.0 and a12 == 0.0:
            break
        c, s, t = _rotation(a00, a01, a11)
        a00, a01, a11 = a00 - t * a01, 0.0, a11 + t * a01
        a02, a12 = c * a02 - s * a12, s * a02 + c * a12
        v00, v01 = c * v00 - s * v01, s * v00 + c * v01
        v10, v11 = c * v10 - s * v11, s * v10 + c * v11
        v20, v21 = c * v20 - s * v21, s * v20 + c * v21
        c, s, t = _rotation(a00, a02, a22)
        a00, a02, a22 = a00 - t * a02, 0.0, a22 + t * a02
        a01, a12 = c * a01 - s * a12, s * a01 + c * a12
        v00, v02 = c * v00 - s * v02, s * v00 + c * v02
        v10, v12 = c * v10 - s * v12, s * v10 + c * v12
        v20, v22 = c * v20 - s * v22, s * v20 + c * v22
        c, s, t = _rotation(a11, a12, a22)
        a11, a12, a22 = a11 - t * a12, 0.0, a22 + t * a12
        a01, a02 = c * a01 - s * a02, s * a01 + c * a02
        v01, v02 = c * v01 - s * v02, s * v01 + c * v02
        v11, v12 = c * v11 - s * v12, s * v11 + c * v12
        v21, v22 = c * v21 - s * v22, s * v21 + c * v22
    e0, e1, e2 = max(a00, least), max(a11, least), max(a22, least)
    if a00 < least or a11 < least or a22 < least:
        planes[first, n] = v00 * v00 * e0 + v01 * v01 * e1 + v02 * v02 * e2
        planes[first + 1, n] = v00 * v10 * e0 + v01 * v11 * e1 + v02 * v12 * e2
        planes[first + 2, n] = v00 * v20 * e0 + v01 * v21 * e1 + v02 * v22 * e2
        planes[first + 3, n] = v10 * v10 * e0 + v11 * v11 * e1 + v12 * v12 * e2
        planes[first + 4, n] = v10 * v20 * e0 + v11 * v21 * e1 + v12 * v22 * e2
        planes[first + 5, n] = v20 * v20 * e0 + v21 * v21 * e1 + v22 * v22 * e2
    return e0 * e1 * e2


@inline
def _rotation(p: Scalar, q: Scalar, r: Scalar) -> Scalar:
    """Return cosine, sine and tangent of the smaller of the two rotations that make [[p, q], [q, r]] diagonal."""
    if abs(q) <= 1e-18 * (abs(p) + abs(r)) or q == 0.0:
        # Smaller than the last bit of the entries that it would change.
        return 1.0, 0.0, 0.0
    h = (r - p) / (2.0 * q)
    t = 1.0 / (abs(h) + math.sqrt(h * h + 1.0))
    t = -t if h < 0.0 else t
    c = 1.0 / math.sqrt(t * t + 1.0)
    return c, t * c, t


@inline
def half_chord(U: Scalar) -> Scalar:
    """Return half the chord of the unit disk at u = ``U``; 0 outside the disk."""
    square = (1.0 - U) * (1.0 + U)
    return math.sqrt(square if square > 0.0 else 0.0)


@inline
def half_plane(U: Scalar, chord: Scalar, arc: Scalar) -> Scalar:
    """Return the share of the unit disk with u <= U; ``chord``: `half_chord` at U, ``arc``: `angle` (U, chord)."""
    share = 1.0 - (arc - U * chord) / math.pi
    share = 0.0 if U <= -1.0 else share
    return 1.0 if U >= 1.0 else share


@inline
def corner_share(
    U: Scalar,
    su: Scalar,
    arc_u: Scalar,
    left: Scalar,
    V: Scalar,
    sv: Scalar,
    arc_v: Scalar,
    below: Scalar,
    rho: Scalar,
    beta: Scalar,
    arc_rho: Scalar,
) -> Scalar:
    """Return the share of the unit disk with u <= U and rho u + beta v <= V.

    ``su``, ``arc_u``, ``left``: half chord, angle and share of the line at U; ``sv``, ``arc_v``, ``below``: the same at
    V; ``arc_rho`` = angle(rho, beta). No branches, so that loops vectorise.
    """
    # The lines cross inside the disk: a sector between the chords, and two triangles to the crossing.
    rise = V - rho * U
    pv = rise / beta
    bu = V * rho - sv * beta
    bv = V * beta + sv * rho
    triangles = (U * bv - pv * bu) + (U * pv + su * U)
    crossed = (2.0 * math.pi - arc_u - arc_v - arc_rho + triangles) / (2.0 * math.pi)
    # They do not cross inside: each chord lies wholly on one side of the other line, as does its midpoint.
    u_inside = rho * U < V
    v_inside = rho * V < U
    apart = below if v_inside else 0.0
    apart = (left + below - 1.0 if v_inside else left) if u_inside else apart
    share = crossed if rise * rise < beta * beta * (su * su) else apart
    share = left if V >= 1.0 else share
    share = below if U >= 1.0 else share
    return 0.0 if (U <= -1.0) | (V <= -1.0) else share


@inline
def ellipse_shares(
    x: Scalar,
    y: Scalar,
    ex: Scalar,
    ey: Scalar,
    rho: Scalar,
    beta: Scalar,
    i0: Scalar,
    j0: Scalar,
    ni: Scalar,
    nj: Scalar,
    a: Scalar,
    lines: F8,
    shares: F8,
) -> Scalar:
    """Fill ``shares`` with the ellipse's shares in the cells i0 .. i0 + ni - 1, j0 .. j0 + nj - 1, row by row.

    Returns the largest share. (x, y): centre. (ex, ey): half extents k sx, k sy. ``lines`` (5, >= ni + 1) is scratch.
    """
    for i in range(ni + 1):
        U = ((i0 + i) * a - x) / ex
        su = half_chord(U)
        arc = angle(U, su)
        lines[0, i] = U
        lines[1, i] = su
        lines[2, i] = arc
        lines[3, i] = half_plane(U, su, arc)
    largest = 0.0
    if nj == 1:
        for i in range(ni):
            p = max(lines[3, i + 1] - lines[3, i], 0.0)
            shares[i] = p
            largest = max(largest, p)
        return largest
    arc_rho = angle(rho, beta)
    for j in range(nj + 1):
        V = ((j0 + j) * a - y) / ey
        sv = half_chord(V)
        arc = angle(V, sv)
        below = half_plane(V, sv, arc)
        before = 0.0
        under = 0.0
        for i in range(ni + 1):
            g = corner_share(lines[0, i], lines[1, i], lines[2, i], lines[3, i], V, sv, arc, below, rho, beta, arc_rho)
            if i > 0 and j > 0:
                p = max((g - before) - (lines[4, i] - under), 0.0)
                shares[(j - 1) * ni + i - 1] = p
                largest = max(largest, p)
            before = g
            under = lines[4, i]
            lines[4, i] = g
    return largest
