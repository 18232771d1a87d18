"""A pose's covariance as it is used: what a message means by it, and what the configuration makes of it."""

import math
from dataclasses import dataclass

import numpy as np

from roughmap_schemas.robot_sections import Policy
from roughmap_service.run.pose_algebra import Floats

NOT_ESTIMATED = -1.0
"""A variance of this value means that there is no estimate, as in ROS messages."""

UNKNOWN_VARIANCE = (1e4, 1e4, 1e4, 1e2, 1e2, 1e2)
"""Variances from which on a number means "not estimated": 100 m and 10 rad are no accuracy. Odometry of wheels gives
1e6 and more to what it does not measure."""

TOLERANCE = 1e-6
"""How far below 0 an eigenvalue of the correlation matrix may be: rounding in a filter, not a contradiction."""


@dataclass(frozen=True, slots=True)
class Settled:
    """A covariance (6, 6), None for `input.pose_sigma`, and the axes that the message did not estimate, from 0."""

    covariance: Floats | None
    unestimated: tuple[int, ...] = ()


class BadCovariance(ValueError):
    """A matrix that is no covariance; the message says why."""


def settle(covariance: Floats | None, sigma: Floats, policy: Policy) -> Settled:
    """Return the covariance (6, 6) that a pose gets, in the axes and units of the message's.

    ``sigma`` (6,) is `input.pose_sigma`: it stands in for what the message does not estimate, and is the bound of the
    policies ``floor`` and ``cap``, which scale rows and columns and so keep the correlations. Raises BadCovariance.
    """
    if covariance is None:
        return Settled(None)
    c: list[list[float]] = covariance.tolist()
    if c[0][0] == NOT_ESTIMATED and not any(c[i][j] for i in range(6) for j in range(6) if i or j):
        return Settled(None, tuple(range(6)))
    variances = [float(s) * float(s) for s in sigma]
    unestimated = tuple(i for i in range(6) if c[i][i] == NOT_ESTIMATED or c[i][i] >= UNKNOWN_VARIANCE[i])
    for i in range(6):
        if i in unestimated:
            _replace(c, i, variances[i])
        elif c[i][i] < 0.0:
            raise BadCovariance(f"variance {c[i][i]:g} is negative")
    slack = _slack(c)
    if policy == "configured":
        return Settled(None, unestimated)
    if policy != "message":
        for i in range(6):
            if (c[i][i] < variances[i]) if policy == "floor" else (c[i][i] > variances[i]):
                _scale(c, i, variances[i])
    for i in range(6):
        c[i][i] *= 1.0 + slack
    return Settled(np.array(c, np.float64), unestimated)


def _replace(c: list[list[float]], i: int, variance: float) -> None:
    for j in range(6):
        c[i][j] = c[j][i] = 0.0
    c[i][i] = variance


def _scale(c: list[list[float]], i: int, variance: float) -> None:
    """Scale row and column i so that its variance becomes this one.

    A variance so small that the factor overflows is rounding: its correlations count as 0.
    """
    if c[i][i] > 0.0:
        factor = math.sqrt(variance / c[i][i])
        if math.isinf(factor):
            factor = 0.0
        for j in range(6):
            c[i][j] = c[j][i] = c[i][j] * factor
    c[i][i] = variance


def _slack(c: list[list[float]]) -> float:
    """Return what to add to the variances, relative to them, so that the matrix is a covariance; raise if it is too far
    from one."""
    if not any(any(c[i][:i]) for i in range(1, 6)):  # nothing is correlated, as with most drivers
        return 0.0
    sigmas = [math.sqrt(c[i][i]) for i in range(6)]
    r = [[0.0] * 6 for _ in range(6)]
    for i in range(6):
        r[i][i] = 1.0
        for j in range(i):
            if c[i][j] == 0.0:
                continue
            scale = sigmas[i] * sigmas[j]
            if abs(c[i][j]) > (1.0 + TOLERANCE) * scale:
                raise BadCovariance(f"covariance {c[i][j]:g} is larger than its variances allow ({scale:g})")
            r[i][j] = c[i][j] / scale
    if _is_definite(r, 0.0):
        return 0.0
    if not _is_definite(r, TOLERANCE):
        raise BadCovariance("the matrix is not positive semidefinite")
    return TOLERANCE


def _is_definite(r: list[list[float]], more: float) -> bool:
    """Whether all pivots of r + more I are at least 0: L D L^T in a fixed order; r is a lower triangle."""
    pivots = [0.0] * 6
    factors = [[0.0] * 6 for _ in range(6)]
    for i in range(6):
        for j in range(i):
            total = r[i][j]
            for k in range(j):
                total -= factors[i][k] * factors[j][k] * pivots[k]
            if pivots[j] > 0.0:
                factors[i][j] = total / pivots[j]
            elif total != 0.0:
                return False
        pivot = r[i][i] + more
        for k in range(i):
            pivot -= factors[i][k] * factors[i][k] * pivots[k]
        if pivot < 0.0:
            return False
        pivots[i] = pivot
    return True
