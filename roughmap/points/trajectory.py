"""The robot's trajectory: poses with covariances, and the pose interpolated at any time between them."""

import math
from dataclasses import dataclass, field

import numpy as np

from roughmap.arrays import F8, I8, Scalar
from roughmap.jit import inline, kernel
from roughmap.points.checks import checked_floats
from roughmap.points.poly import angle, sinc_of_square
from roughmap.points.rotations import rotation_matrix, unit_quaternions

_STAMP_LIMIT = 1 << 62
"""Stamps below this limit have differences that fit int64."""

_FIRST, _LAST = -(1 << 63), (1 << 63) - 1
"""Before and after any stamp."""

UPPER = [(row, column) for row in range(6) for column in range(row, 6)]
"""The 21 entries of a pose covariance that are used: its upper triangle, row by row."""


@kernel
def _half_angles(rotation: F8, theta: F8, flip: F8, inverse_sinc: F8) -> None:
    """For each pair of successive poses, compute what slerp needs.

    ``theta``: the angle between the two quaternions along the shorter arc; ``flip``: the sign of the second quaternion;
    ``inverse_sinc``: 1 / sinc(theta).
    """
    for m in range(len(theta)):
        dot = 0.0
        for c in range(4):
            dot += rotation[m, c] * rotation[m + 1, c]
        sign = -1.0 if dot < 0.0 else 1.0
        apart = 0.0
        along = 0.0
        for c in range(4):
            difference = sign * rotation[m + 1, c] - rotation[m, c]
            total = sign * rotation[m + 1, c] + rotation[m, c]
            apart += difference * difference
            along += total * total
        theta[m] = 2.0 * angle(math.sqrt(along), math.sqrt(apart))
        flip[m] = sign
        inverse_sinc[m] = 1.0 / sinc_of_square(theta[m] * theta[m])


@inline
def find_bracket(stamps: I8, t: Scalar, max_gap_ns: Scalar) -> Scalar:
    """Find the two poses around ``t``.

    Returns the index of the last pose at or before ``t`` (-1 if none), the stamps of that pose and of the next one, and
    whether times between them can be interpolated: both poses exist and are at most ``max_gap_ns`` apart.
    """
    size = len(stamps)
    low = -1
    high = size
    while high - low > 1:
        middle = (low + high) // 2
        if stamps[middle] <= t:
            low = middle
        else:
            high = middle
    before = stamps[low] if low >= 0 else np.int64(_FIRST)
    after = stamps[high] if high < size else np.int64(_LAST)
    linked = low >= 0 and high < size and float(after - before) <= max_gap_ns
    return np.int64(low), before, after, linked


@inline
def pose_pair(path: Scalar, low: Scalar, exact: Scalar) -> Scalar:
    """Gather pose ``low`` and the next one for `quaternion_at`, `position_at` and `covariance_at`.

    ``path``: `Trajectory.arrays`. ``exact``: the time asked for is the stamp of pose ``low``; there may be no next
    pose.
    """
    stamps, position, rotation, covariance, theta, flip, inverse_sinc = path
    high = low if exact else low + 1
    # With an exact stamp the weights are 1 and 0, and nothing is read of a next pose.
    turn = (0.0, 1.0, 1.0) if exact else (theta[low], flip[low], inverse_sinc[low])
    p, q, c = position, rotation, covariance
    return (
        (float(stamps[high] - stamps[low]), exact),
        turn,
        ((q[low, 0], q[low, 1], q[low, 2], q[low, 3]), (q[high, 0], q[high, 1], q[high, 2], q[high, 3])),
        ((p[low, 0], p[low, 1], p[low, 2]), (p[high, 0] - p[low, 0], p[high, 1] - p[low, 1], p[high, 2] - p[low, 2])),
        (_row(c, low), _rise(c, low, high)),
    )


@inline
def quaternion_at(pair: Scalar, since: Scalar, until: Scalar) -> Scalar:
    """Interpolate the rotation ``since`` ns after the first pose and ``until`` ns before the second.

    Returns a unit quaternion and the elapsed fraction u of the interval, 0 to 1. Slerp:
    q = (1 - u) sinc((1 - u) th) / sinc(th) q0 + u sinc(u th) / sinc(th) q1, then normalised.
    """
    (span, exact), (theta, flip, inverse_sinc), (q0, q1), _, _ = pair
    u = 0.0 if exact else since / span
    rest = until / span
    a0 = rest * theta
    a1 = u * theta
    w0 = 1.0 if exact else rest * sinc_of_square(a0 * a0) * inverse_sinc
    w1 = 0.0 if exact else u * sinc_of_square(a1 * a1) * inverse_sinc * flip
    qx = w0 * q0[0] + w1 * q1[0]
    qy = w0 * q0[1] + w1 * q1[1]
    qz = w0 * q0[2] + w1 * q1[2]
    qw = w0 * q0[3] + w1 * q1[3]
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    return (qx / norm, qy / norm, qz / norm, qw / norm), u


@inline
def position_at(pair: Scalar, u: Scalar) -> Scalar:
    """Interpolate the position linearly."""
    start, rise = pair[3]
    return start[0] + rise[0] * u, start[1] + rise[1] * u, start[2] + rise[2] * u


@inline
def covariance_at(pair: Scalar, u: Scalar) -> Scalar:
    """Interpolate the covariance linearly; 21 numbers in the order of `UPPER`."""
    c, d = pair[4]
    return (
        c[0] + d[0] * u,
        c[1] + d[1] * u,
        c[2] + d[2] * u,
        c[3] + d[3] * u,
        c[4] + d[4] * u,
        c[5] + d[5] * u,
        c[6] + d[6] * u,
        c[7] + d[7] * u,
        c[8] + d[8] * u,
        c[9] + d[9] * u,
        c[10] + d[10] * u,
        c[11] + d[11] * u,
        c[12] + d[12] * u,
        c[13] + d[13] * u,
        c[14] + d[14] * u,
        c[15] + d[15] * u,
        c[16] + d[16] * u,
        c[17] + d[17] * u,
        c[18] + d[18] * u,
        c[19] + d[19] * u,
        c[20] + d[20] * u,
    )


@inline
def interpolate(path: Scalar, low: Scalar, t: Scalar) -> Scalar:
    """Return the pose at ``t``, between pose ``low`` and the next: R (9), t (3), covariance (21, `UPPER`)."""
    stamps = path[0]
    exact = stamps[low] == t
    pair = pose_pair(path, low, exact)
    until = 0.0 if exact else float(stamps[low + 1] - t)
    q, u = quaternion_at(pair, float(t - stamps[low]), until)
    return (*rotation_matrix(*q), *position_at(pair, u), *covariance_at(pair, u))


@inline
def _row(c: F8, low: Scalar) -> Scalar:
    return (
        c[low, 0],
        c[low, 1],
        c[low, 2],
        c[low, 3],
        c[low, 4],
        c[low, 5],
        c[low, 6],
        c[low, 7],
        c[low, 8],
        c[low, 9],
        c[low, 10],
        c[low, 11],
        c[low, 12],
        c[low, 13],
        c[low, 14],
        c[low, 15],
        c[low, 16],
        c[low, 17],
        c[low, 18],
        c[low, 19],
        c[low, 20],
    )


@inline
def _rise(c: F8, low: Scalar, high: Scalar) -> Scalar:
    return (
        c[high, 0] - c[low, 0],
        c[high, 1] - c[low, 1],
        c[high, 2] - c[low, 2],
        c[high, 3] - c[low, 3],
        c[high, 4] - c[low, 4],
        c[high, 5] - c[low, 5],
        c[high, 6] - c[low, 6],
        c[high, 7] - c[low, 7],
        c[high, 8] - c[low, 8],
        c[high, 9] - c[low, 9],
        c[high, 10] - c[low, 10],
        c[high, 11] - c[low, 11],
        c[high, 12] - c[low, 12],
        c[high, 13] - c[low, 13],
        c[high, 14] - c[low, 14],
        c[high, 15] - c[low, 15],
        c[high, 16] - c[low, 16],
        c[high, 17] - c[low, 17],
        c[high, 18] - c[low, 18],
        c[high, 19] - c[low, 19],
        c[high, 20] - c[low, 20],
    )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the robot's base in the map frame, M >= 1.

    ``stamp_ns`` (M,) int64, strictly increasing; ``position`` (M, 3) metres; ``rotation`` (M, 4) quaternions x, y, z,
    w, normalised here; ``covariance`` (M, 6, 6) in the order x y z roll pitch yaw, about the map's axes: the true pose
    is (Exp(dtheta) R, t + dt). Only the upper triangle is used. ValueError for other shapes and for numbers that are
    not finite.
    """

    stamp_ns: I8
    position: F8
    rotation: F8
    covariance: F8
    arrays: tuple[I8, F8, F8, F8, F8, F8, F8] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamp_ns)
        if stamps.ndim != 1 or not len(stamps) or stamps.dtype.kind not in "iu":
            raise ValueError("Trajectory.stamp_ns: expected a one-dimensional array of at least one integer")
        if stamps.dtype.kind == "u" and int(stamps.max()) > np.iinfo(np.int64).max:
            raise ValueError("Trajectory.stamp_ns: expected signed 64-bit integers")
        stamps = np.array(stamps, np.int64)
        if stamps.min() <= -_STAMP_LIMIT or stamps.max() >= _STAMP_LIMIT:  # differences must not overflow
            raise ValueError("Trajectory.stamp_ns: expected stamps within 2^62 ns of the epoch")
        if (stamps[1:] <= stamps[:-1]).any():
            raise ValueError("Trajectory.stamp_ns: expected strictly increasing stamps")
        number = len(stamps)
        rotation = checked_floats(self.rotation, (number, 4), "Trajectory.rotation")
        covariance = checked_floats(self.covariance, (number, 6, 6), "Trajectory.covariance")
        put = object.__setattr__
        put(self, "stamp_ns", stamps)
        put(self, "position", checked_floats(self.position, (number, 3), "Trajectory.position"))
        put(self, "rotation", unit_quaternions(rotation, "Trajectory.rotation"))
        put(self, "covariance", covariance)
        rows, columns = zip(*UPPER, strict=True)
        packed = np.ascontiguousarray(covariance[:, rows, columns])
        theta, flip, inverse_sinc = np.zeros(number - 1), np.zeros(number - 1), np.zeros(number - 1)
        _half_angles(self.rotation, theta, flip, inverse_sinc)
        put(self, "arrays", (stamps, self.position, self.rotation, packed, theta, flip, inverse_sinc))
