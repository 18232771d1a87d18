"""Functions that no layer may take from the C library: there they have other last bits on other processors.

Each is arithmetic and square roots alone, without a branch, so that loops over cells vectorise. The coefficients were
fitted so that the largest error is least.
"""

from math import inf, pi, sqrt

from roughmap.jit import inline

QUARTER, HALF = pi / 4.0, pi / 2.0

EIGHTH_TANGENT, THREE_EIGHTHS_TANGENT = sqrt(2.0) - 1.0, sqrt(2.0) + 1.0
"""tan(pi / 8) and tan(3 pi / 8)."""

ROOT_HALF = sqrt(0.5)

LARGEST_T = 1e6
"""From here on a probability differs from 1 by less than 1e-11; the squares of larger values could overflow."""

TERMS = 40
"""Of the continued fraction of a tangent; for the largest angles below pi / 2 it needs about 20."""


@inline
def erf(x: float) -> float:
    """Return the error function of ``x`` >= 0, to 1e-10; 1 for infinity, NaN for NaN.

    The form is 1 - 1 / p(x)^16 with a polynomial p (Abramowitz and Stegun 7.1.28), here of degree 10.
    """
    p = -1.61381359e-06 + x * 1.16312284e-07
    p = 1.11550839e-04 + x * (-4.12261969e-05 + x * (1.17648023e-05 + x * p))
    p = 9.28773317e-03 + x * (1.49571970e-04 + x * (2.30022202e-04 + x * p))
    p = 1.0 + x * (7.05236981e-02 + x * (4.22755328e-02 + x * p))
    p *= p
    p *= p
    p *= p
    return 1.0 - 1.0 / (p * p)


@inline
def atan(x: float) -> float:
    """Return the arc tangent of ``x`` >= 0, to 1e-11; pi / 2 for infinity, NaN for NaN.

    Angles beyond pi / 8 are measured from pi / 4 or pi / 2.
    """
    above, below = x, 1.0
    angle = 0.0
    if x > EIGHTH_TANGENT:
        above, below, angle = x - 1.0, x + 1.0, QUARTER
    if x > THREE_EIGHTHS_TANGENT:
        above, below, angle = -1.0, x, HALF
    t = above / below
    z = t * t
    p = 0.11032713820542955 + z * (-0.08416923300185145 + z * 0.04632960083363299)
    p = -0.3333333179151037 + z * (0.19999856141592123 + z * (-0.1428088442451399 + z * p))
    return angle + t * (1.0 + z * p)


@inline
def student_within(t: float, freedom: float) -> float:
    """Return P(|T| <= t), t >= 0, of Student's distribution with ``freedom`` >= 2 degrees, to 3e-5; NaN for NaN.

    The deviate z of the normal distribution with the same probability is near sqrt(freedom log(1 + t^2 / freedom))
    (Wallace 1959). With r = (1 + t^2 / freedom)^(1/8) the logarithm is 16 artanh(q), q = (r - 1) / (r + 1), and what z
    differs by from sqrt(16 freedom q) is a polynomial in q and 2 / freedom. ``freedom`` may be infinite.
    """
    t = LARGEST_T if t > LARGEST_T else t
    u = 2.0 / freedom
    square = 0.5 * u * t * t
    root2 = sqrt(1.0 + square)
    root4 = sqrt(root2)
    root8 = sqrt(root4)
    # (root2 - 1)(root2 + 1) = square, and so on: q without a difference of nearly equal numbers
    product = (root2 + 1.0) * (root4 + 1.0) * ((root8 + 1.0) * (root8 + 1.0))
    q = square / product
    c0 = 1.0 + u * (-0.12602974780684362 + u * 0.01217064061023329)
    c1 = 0.017768622847159667 + u * (0.11659677250607116 + u * 0.0364177762221774)
    c2 = 0.004429763315594107 + u * (0.4247999155554591 - u * 0.3915031832465623)
    z = 4.0 * t / sqrt(product) * (c0 + q * (c1 + q * c2))
    return erf(ROOT_HALF * z)


@inline
def student_95(freedom: float) -> float:
    """Return the t with P(|T| <= t) = 0.95 for ``freedom`` >= 2 degrees, to 3e-6 of it; NaN for NaN."""
    u = 2.0 / freedom
    p = 0.7018733092955738 + u * (0.33585127674750653 + u * (0.06770134463989791 + u * 0.05081517367849264))
    return 1.959960017753073 + u * (1.18644289907195 + u * p)


def tan(x: float) -> float:
    """Return the tangent of an angle ``x`` > 0, to 1e-14 of it; infinity from pi / 2 on.

    Lambert's continued fraction x / (1 - x^2 / (3 - x^2 / (5 - ...))).
    """
    if x >= HALF:
        return inf
    below = 2.0 * TERMS + 1.0
    for odd in range(2 * TERMS - 1, 0, -2):
        below = odd - x * x / below
    return x / below
