"""The robot's way: poses with covariances, and the pose at any time between them."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, Scalar
from roughmap.jit import inline, kernel
from roughmap.points.poly import angle, sinc_of_square

QUATERNION_LEAST_NORM = 1e-6
"""A quaternion shorter than this says nothing about a rotation; it is refused."""

_STAMP_LIMIT = 1 << 62
"""Differences of stamps within this fit int64."""

_FIRST, _LAST = -(1 << 63), (1 << 63) - 1
"""Before and after all stamps."""

UPPER = [(row, column) for row in range(6) for column in range(row, 6)]
"""The 21 entries of a pose covariance that are read: its upper triangle, row by row."""


@inline
def rotation_matrix(x: Scalar, y: Scalar, z: Scalar, w: Scalar) -> Scalar:
    """The nine entries, row by row, of the rotation by a unit quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - z * w),
        2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),
        2.0 * (y * z + x * w),
        1.0 - 2.0 * (x * x + y * y),
    )


@kernel
def matrix_of(rotation: F8) -> Scalar:
    """The nine entries of the rotation by one unit quaternion (4,) xyzw."""
    return rotation_matrix(rotation[0], rotation[1], rotation[2], rotation[3])


@kernel
def _half_angles(rotation: F8, theta: F8, flip: F8, inverse_sinc: F8) -> None:
    """For each bracket: the angle between its quaternions (shorter arc), the sign of the second, 1 / sinc(angle)."""
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
    """The last pose at or before ``t``, or -1; the times from which and until which that holds; whether times between
    them have a pose: only if there is a next one, not farther away than ``max_gap_ns``.
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
def pose_pair(way: Scalar, low: Scalar, exact: Scalar) -> Scalar:
    """What `quaternion_at`, `position_at` and `covariance_at` take: the poses around times that have one bracket.

    ``way``: `Trajectory.arrays`. ``exact``: the times are the stamp of ``low``, and there may be no next pose.
    """
    stamps, position, rotation, covariance, theta, flip, inverse_sinc = way
    high = low if exact else low + 1
    # Without a next pose nothing is read of the bracket, and the two weights are 1 and 0.
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
    """The rotation ``since`` ns after the first pose and ``until`` before the second, a unit quaternion, and how far
    that is on the way, 0 to 1.

    Slerp: q = (1 - u) sinc((1 - u) th) / sinc(th) q0 + u sinc(u th) / sinc(th) q1, then normalised.
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
    """The position, linear between the two poses."""
    start, rise = pair[3]
    return start[0] + rise[0] * u, start[1] + rise[1] * u, start[2] + rise[2] * u


@inline
def covariance_at(pair: Scalar, u: Scalar) -> Scalar:
    """The covariance (21, `UPPER`), linear between the two poses."""
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
def interpolate(way: Scalar, low: Scalar, t: Scalar) -> Scalar:
    """The pose at ``t`` in the bracket that begins at ``low``: 33 numbers, R (9), t (3), covariance (21, `UPPER`)."""
    stamps = way[0]
    exact = stamps[low] == t
    pair = pose_pair(way, low, exact)
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


def float_array(value: npt.ArrayLike, shape: tuple[int, ...], name: str) -> F8:
    """``value`` as a contiguous float64 array of finite numbers of this shape, else ValueError."""
    try:
        array = np.array(value, np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected an array of numbers of shape {shape}") from error
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers")
    return array


def unit_quaternions(rotation: F8, name: str) -> F8:
    """(M, 4) quaternions xyzw, normalised; ValueError where a norm is below 1e-6."""
    x, y, z, w = rotation.T
    # Divided by the largest part first, so that no square over- or underflows.
    largest = np.maximum(np.maximum(abs(x), abs(y)), np.maximum(abs(z), abs(w)))
    if (largest < QUATERNION_LEAST_NORM / 2).any():
        raise ValueError(f"{name}: expected quaternions x, y, z, w of norm at least {QUATERNION_LEAST_NORM}")
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if (norm * largest < QUATERNION_LEAST_NORM).any():
        raise ValueError(f"{name}: expected quaternions x, y, z, w of norm at least {QUATERNION_LEAST_NORM}")
    return np.ascontiguousarray(np.stack([x / norm, y / norm, z / norm, w / norm], axis=1))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the robot's base in the map frame.

    ``stamp_ns`` (M,) int64, strictly rising; ``position`` (M, 3) metres; ``rotation`` (M, 4) quaternions x, y, z, w
    (normalised here); ``covariance`` (M, 6, 6), order x y z roll pitch yaw, about the map's axes: the true pose is
    (Exp(dtheta) R, t + dt). Only its upper triangle is read. M >= 1; else, or for numbers that are not finite,
    ValueError.
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
            raise ValueError("Trajectory.stamp_ns: expected integers of 64 bits, signed")
        stamps = np.array(stamps, np.int64)
        if stamps.min() <= -_STAMP_LIMIT or stamps.max() >= _STAMP_LIMIT:  # or a difference may overflow
            raise ValueError("Trajectory.stamp_ns: expected stamps within 2^62 ns of the epoch")
        if (stamps[1:] <= stamps[:-1]).any():
            raise ValueError("Trajectory.stamp_ns: expected strictly rising stamps")
        number = len(stamps)
        rotation = float_array(self.rotation, (number, 4), "Trajectory.rotation")
        covariance = float_array(self.covariance, (number, 6, 6), "Trajectory.covariance")
        put = object.__setattr__
        put(self, "stamp_ns", stamps)
        put(self, "position", float_array(self.position, (number, 3), "Trajectory.position"))
        put(self, "rotation", unit_quaternions(rotation, "Trajectory.rotation"))
        put(self, "covariance", covariance)
        rows, columns = zip(*UPPER, strict=True)
        packed = np.ascontiguousarray(covariance[:, rows, columns])
        theta, flip, inverse_sinc = np.zeros(number - 1), np.zeros(number - 1), np.zeros(number - 1)
        _half_angles(self.rotation, theta, flip, inverse_sinc)
        put(self, "arrays", (stamps, self.position, self.rotation, packed, theta, flip, inverse_sinc))
