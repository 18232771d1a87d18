"""Answers without a division, for points of which the answer is beyond doubt.

Division is the slowest arithmetic of phase one: the exact way takes 14 a point to judge a covariance and to find cells.
Each test here answers "surely" or "in doubt", with a margin far above the rounding errors of both ways, so that
"surely" always agrees with the exact way to the bit. u = 2^-53 is the unit of rounding.
"""

import numpy as np

from roughmap.arrays import Scalar
from roughmap.jit import inline

_LEAST, _MOST = 1e-60, 1e60
"""Variances in this range have products of three that neither underflow nor overflow."""

_MARGIN = 1e-6
"""Least value of the scaled minors below."""

_NEAR, _TINY = 1e-14, 1e-300
"""A quotient is in doubt within so much of a border, as a fraction of it and absolutely."""


@inline
def is_surely_covariance(xx: Scalar, xy: Scalar, xz: Scalar, yy: Scalar, yz: Scalar, zz: Scalar) -> Scalar:
    """Whether the matrix surely passes `is_covariance`: positive definite, and well away from singular.

    Let C be the matrix of the correlations r, s, t of xy, xz, yz. The tests say, up to rounding, that r^2 <= 1 - 1e-6,
    s^2 <= 1, t^2 <= 1 and det C >= 1e-6. With correlations within 1 no term of det C exceeds 1, so its rounding error
    is below 20 u. So C is positive definite. Its eigenvalues add up to 3, so the least of them is at least
    1e-6 / 1.5^2 > 4e-7. The exact way forms the pivots of the matrix over its trace, plus a slack on the diagonal that
    only raises the eigenvalues. Pivots are Schur complements: in parts of their diagonal entries they are at least
    4e-7. The rounding error of the second is at most 4 u, and that of the third, which divides by the second, at most
    20 u / 4e-7 < 1e-8. So all of them come out above zero. NaN and infinite entries fail a comparison.
    """
    first = xx * yy
    minor = first - xy * xy
    det = minor * zz + (xy * yz - yy * xz) * xz + (xy * xz - xx * yz) * yz
    sized = (xx > _LEAST) & (yy > _LEAST) & (zz > _LEAST) & (xx < _MOST) & (yy < _MOST) & (zz < _MOST)
    correlated = (xz * xz <= xx * zz) & (yz * yz <= yy * zz)
    return sized & correlated & (minor > _MARGIN * first) & (det > _MARGIN * (first * zz))


@inline
def is_floor_in_doubt(t: Scalar) -> Scalar:
    """Whether floor(v (1/a)) may differ from floor(v / a), for t = v (1/a) as computed.

    The reciprocal and the product are rounded, the quotient once: both are within 4 u |t| < 5e-16 |t| of each other, or
    a few denormals apart. They have the same floor if no integer lies within that of t. NaN and infinity are in doubt,
    and so is every |t| above 5e13.
    """
    return not (abs(t - np.rint(t)) > _NEAR * abs(t) + _TINY)
