"""Sine and arc tangent as polynomials, with the same bits on every machine.

From point to cell no function of the C library is used but ``sqrt``: glibc chooses variants by CPU, and their last bits
differ. The coefficients are Chebyshev interpolants computed at 60 digits and rounded to float64, evaluated by Horner's
rule in a fixed order.
"""

import math

from roughmap.arrays import Scalar
from roughmap.jit import inline

_TAN_EIGHTH_TURN = math.sqrt(2.0) - 1.0
"""tan(pi / 8). Beyond it the argument is rotated by pi / 4, which keeps the polynomial short."""


@inline
def sinc_of_square(s: Scalar) -> Scalar:
    """Return sin(x) / x for s = x^2 in [0, (pi/2)^2]. The interpolant is within 2.1e-19, the result within 2.3e-16."""
    p = 2.7215713949149307e-15
    p = p * s - 7.64302622970216e-13
    p = p * s + 1.6058940866200353e-10
    p = p * s - 2.5052106890331295e-08
    p = p * s + 2.7557319211227065e-06
    p = p * s - 0.0001984126984120866
    p = p * s + 0.008333333333333186
    p = p * s - 0.16666666666666666
    return p * s + 1.0


@inline
def _small_arctan(t: Scalar) -> Scalar:
    """Return atan(t) for |t| <= tan(pi/8). The interpolant of atan(t) / t is within 1.3e-18."""
    s = t * t
    p = -0.017803896394812564
    p = p * s + 0.03796390316111083
    p = p * s - 0.05035049795312439
    p = p * s + 0.05846866752275139
    p = p * s - 0.06662950246036792
    p = p * s + 0.07692045194561481
    p = p * s - 0.09090896801472813
    p = p * s + 0.11111110744657099
    p = p * s - 0.14285714279244968
    p = p * s + 0.19999999999940837
    p = p * s - 0.3333333333333312
    return t + t * (p * s)


@inline
def angle(c: Scalar, s: Scalar) -> Scalar:
    """Return atan2(s, c) for s >= 0, in [0, pi]; c and s must not both be zero. Relative error within 3e-16."""
    x = abs(c)
    low = s if s < x else x
    high = x if s < x else s
    # Select the operands, not the code path: without a branch, loops vectorise.
    beyond = low > _TAN_EIGHTH_TURN * high
    top = low - high if beyond else low
    bottom = low + high if beyond else high
    a = (0.25 * math.pi if beyond else 0.0) + _small_arctan(top / bottom)
    a = 0.5 * math.pi - a if s > x else a
    return math.pi - a if c < 0.0 else a
