"""The covariance of a point in the map (eq. 1), written out in a fixed order: no BLAS, the same bits everywhere."""

import math

from roughmap.arrays import Scalar
from roughmap.jit import inline

_NOTHING = (-0.0, -0.0, -0.0, -0.0, -0.0, -0.0)
"""Terms that change no sum, to the bit. The terms of a mounting without uncertainty are zeros of either sign, so only
the sign of a sum that is zero anyway can depend on leaving them out, and on that sign depends no cell."""

VARIANCE_MAX = 1e30
"""Square metres; far above any that says something, and its sums stay finite in float32."""


@inline
def rotate(m: Scalar, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Multiply the 3x3 matrix in the first nine numbers of ``m`` by a vector."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


@inline
def _rotated_diagonal(r: Scalar, a: Scalar, b: Scalar, c: Scalar) -> Scalar:
    """Return the upper triangle of R diag(a, b, c) R^T."""
    return (
        r[0] * r[0] * a + r[1] * r[1] * b + r[2] * r[2] * c,
        r[0] * r[3] * a + r[1] * r[4] * b + r[2] * r[5] * c,
        r[0] * r[6] * a + r[1] * r[7] * b + r[2] * r[8] * c,
        r[3] * r[3] * a + r[4] * r[4] * b + r[5] * r[5] * c,
        r[3] * r[6] * a + r[4] * r[7] * b + r[5] * r[8] * c,
        r[6] * r[6] * a + r[7] * r[7] * b + r[8] * r[8] * c,
    )


@inline
def shared_terms(pose: Scalar, mount: Scalar, mounted: Scalar) -> Scalar:
    """Return the terms of the covariance that all points of a pose share, 29 numbers.

    A (6, upper triangle): translation block of S_pose plus that of S_mount in map axes; B (9): translation-rotation
    block of S_pose; C (6): rotation block of S_pose; D (6): rotation block of S_mount in map axes; the zz entries of
    both translation blocks, apart. ``mounted`` False: ``mount`` is zero. A constant, so that its terms are not
    compiled.
    """
    shift = _rotated_diagonal(pose, mount[0], mount[1], mount[2]) if mounted else _NOTHING
    tilt = _rotated_diagonal(pose, mount[3], mount[4], mount[5]) if mounted else _NOTHING
    return (
        pose[12] + shift[0],
        pose[13] + shift[1],
        pose[14] + shift[2],
        pose[18] + shift[3],
        pose[19] + shift[4],
        pose[23] + shift[5],
        pose[15],
        pose[16],
        pose[17],
        pose[20],
        pose[21],
        pose[22],
        pose[24],
        pose[25],
        pose[26],
        pose[27],
        pose[28],
        pose[29],
        pose[30],
        pose[31],
        pose[32],
        tilt[0],
        tilt[1],
        tilt[2],
        tilt[3],
        tilt[4],
        tilt[5],
        pose[23],
        shift[5],
    )


@inline
def _lever_square(c0: Scalar, c1: Scalar, c2: Scalar, c3: Scalar, c4: Scalar, c5: Scalar, l: Scalar) -> Scalar:  # noqa: E741
    """Return the upper triangle of K C K^T with K = -[l]x; C is given by its upper triangle."""
    x, y, z = l
    # D = C K^T, row by row; K^T has the columns (0, lz, -ly), (-lz, 0, lx), (ly, -lx, 0).
    d01 = c2 * x - c0 * z
    d02 = c0 * y - c1 * x
    d10 = c3 * z - c4 * y
    d11 = c4 * x - c1 * z
    d12 = c1 * y - c3 * x
    d20 = c4 * z - c5 * y
    d21 = c5 * x - c2 * z
    d22 = c2 * y - c4 * x
    return (
        z * d10 - y * d20,
        z * d11 - y * d21,
        z * d12 - y * d22,
        x * d21 - z * d01,
        x * d22 - z * d02,
        y * d02 - x * d12,
    )


@inline
def _lever_height(c0: Scalar, c1: Scalar, c3: Scalar, l: Scalar) -> Scalar:  # noqa: E741
    """Return the zz entry of `_lever_square`."""
    x, y, _ = l
    return y * (c0 * y - c1 * x) - x * (c1 * y - c3 * x)


@inline
def height_variances(l: Scalar, m: Scalar, s: Scalar, mounted: Scalar) -> Scalar:  # noqa: E741
    """Return the parts of S's zz entry that come from the pose and from the mounting: zz of J S_pose J^T, of
    J_m S_mount J_m^T. Rounding may leave them slightly negative."""
    x, y, _ = l
    b22 = s[12] * y - s[13] * x
    pose = s[27] + (b22 + b22) + _lever_height(s[15], s[16], s[18], l)
    return pose, s[28] + _lever_height(s[21], s[22], s[24], m) if mounted else 0.0


@inline
def counted_variance(variance: Scalar) -> Scalar:
    """Return a variance as the trust of a cell counts it: at least 0, at most VARIANCE_MAX, and that for NaN."""
    # A comparison instead of min(), which lets NaN through.
    most = variance if variance < VARIANCE_MAX else VARIANCE_MAX
    return most if most > 0.0 else 0.0


@inline
def point_covariance(l: Scalar, m: Scalar, square: Scalar, beam: Scalar, s: Scalar, mounted: Scalar) -> Scalar:  # noqa: E741
    """Return the upper triangle of S (eq. 1) from the levers l and l_m, the squared range and `shared_terms`."""
    sr = beam[0] + beam[1] * math.sqrt(square) + beam[3] * square
    across = beam[2] * beam[2] * square
    along = (sr * sr - across) / square
    x, y, z = l
    pose = _lever_square(s[15], s[16], s[17], s[18], s[19], s[20], l)
    mount = _lever_square(s[21], s[22], s[23], s[24], s[25], s[26], m) if mounted else _NOTHING
    # B K^T: row i is (b1 z - b2 y, b2 x - b0 z, b0 y - b1 x); S gets this and its transpose.
    b00 = s[7] * z - s[8] * y
    b01 = s[8] * x - s[6] * z
    b02 = s[6] * y - s[7] * x
    b10 = s[10] * z - s[11] * y
    b11 = s[11] * x - s[9] * z
    b12 = s[9] * y - s[10] * x
    b20 = s[13] * z - s[14] * y
    b21 = s[14] * x - s[12] * z
    b22 = s[12] * y - s[13] * x
    return (
        across + along * m[0] * m[0] + s[0] + (b00 + b00) + pose[0] + mount[0],
        along * m[0] * m[1] + s[1] + (b01 + b10) + pose[1] + mount[1],
        along * m[0] * m[2] + s[2] + (b02 + b20) + pose[2] + mount[2],
        across + along * m[1] * m[1] + s[3] + (b11 + b11) + pose[3] + mount[3],
        along * m[1] * m[2] + s[4] + (b12 + b21) + pose[4] + mount[4],
        across + along * m[2] * m[2] + s[5] + (b22 + b22) + pose[5] + mount[5],
    )
