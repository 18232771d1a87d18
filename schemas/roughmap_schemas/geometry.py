"""Stamps, vectors and quaternions: between protobuf and numbers, and how they move points."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from roughmap_schemas.faults import bad_message

SECOND_NS: Final = 1_000_000_000
MAX_STAMP_S: Final = 2**32
"""A cell keeps whole seconds in 32 bits."""

MIN_NORM: Final = 1e-6
"""A quaternion shorter than this has no reliable direction."""

ROUNDING: Final = 4e-15
"""Bound on how far the squared norm of a normalised quaternion is from 1, after at most twelve roundings of 1.1e-16."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]


def read_stamp(message: Any, what: str) -> int:
    """Return a message's ``timestamp`` in nanoseconds, 0 if unset; raises ``MessageFault`` outside [0, 2^32 s)."""
    seconds, nanos = message.timestamp.seconds, message.timestamp.nanos
    if not (0 <= seconds < MAX_STAMP_S and 0 <= nanos < SECOND_NS):
        raise bad_message(
            f"{what}.timestamp: expected 0 <= seconds < 2^32 and 0 <= nanos < 10^9; found {seconds} s {nanos} ns"
        )
    return int(seconds) * SECOND_NS + int(nanos)


def write_stamp(message: Any, stamp_ns: int) -> None:
    """Set a message's ``timestamp``; raises ValueError outside [0, 2^32 s)."""
    if not 0 <= stamp_ns < MAX_STAMP_S * SECOND_NS:
        raise ValueError(f"stamp_ns: expected 0 <= stamp_ns < 2^32 s, found {stamp_ns}")
    message.timestamp.seconds, message.timestamp.nanos = divmod(int(stamp_ns), SECOND_NS)


def read_vector(vector: Any, what: str) -> Vector:
    """Return x, y, z; raises ``MessageFault`` unless all are finite."""
    value = (float(vector.x), float(vector.y), float(vector.z))
    if not all(map(math.isfinite, value)):
        raise bad_message(f"{what}: expected three finite numbers; found {value}")
    return value


def read_rotation(quaternion: Any, what: str) -> Quaternion:
    """Return a unit quaternion x, y, z, w; raises ``MessageFault`` unless it is finite and of norm at least 1e-6."""
    value = (float(quaternion.x), float(quaternion.y), float(quaternion.z), float(quaternion.w))
    unit = normalised(value)
    if unit is None:
        raise bad_message(f"{what}: expected a finite quaternion of norm at least 1e-6; found {value}")
    return unit


def normalised(value: Quaternion) -> Quaternion | None:
    """Return the quaternion with norm 1; None if its norm is below 1e-6 or not finite.

    A quaternion whose norm is 1 up to rounding is returned unchanged, so that writing and reading it keeps its bits.
    """
    x, y, z, w = value
    square = x * x + y * y + z * z + w * w
    if abs(square - 1.0) <= ROUNDING:
        return value
    norm = math.sqrt(square)
    if not MIN_NORM <= norm < math.inf:
        return None
    return x / norm, y / norm, z / norm, w / norm


def rotation_matrix(unit: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion, written out so that its bits are the same everywhere."""
    x, y, z, w = unit
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation that turns by b, then by a, normalised; written out so that its bits are the same everywhere.

    The product must not be 0.
    """
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    w = aw * bw - ax * bx - ay * by - az * bz
    n = math.sqrt(x * x + y * y + z * z + w * w)
    return x / n, y / n, z / n, w / n


def quaternion_of(matrix: Matrix) -> Quaternion:
    """Give the unit quaternion of a rotation matrix, which may be rounded.

    The diagonal gives the four squares 4 x^2 .. 4 w^2. The largest, at least 1, is the one to divide by.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    columns = (
        (1 + a - e - i, b + d, c + g, h - f),
        (b + d, 1 - a + e - i, f + h, c - g),
        (c + g, f + h, 1 - a - e + i, d - b),
        (h - f, c - g, d - b, 1 + a + e + i),
    )
    best = max(range(4), key=lambda n: columns[n][n])
    length = math.sqrt(sum(part * part for part in columns[best]))
    x, y, z, w = (part / length for part in columns[best])
    return x, y, z, w


def move(
    points: NDArray[np.floating[Any]], translation: Vector, unit: Quaternion, *, keep_zero_rows: bool
) -> NDArray[np.float64]:
    """Return points (N, 3) rotated and translated, as a new float64 array.

    The sums are written out in a fixed order, because the bits of a matrix product depend on its shape. With
    ``keep_zero_rows``, rows of (0, 0, 0) are left as they are.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(unit)
    x, y, z = (points[:, axis].astype(np.float64) for axis in range(3))
    moved = np.empty((len(points), 3))
    with np.errstate(all="ignore"):  # points that are not finite are rejected later
        moved[:, 0] = ((a * x + b * y) + c * z) + translation[0]
        moved[:, 1] = ((d * x + e * y) + f * z) + translation[1]
        moved[:, 2] = ((g * x + h * y) + i * z) + translation[2]
    if keep_zero_rows:
        moved[(x == 0.0) & (y == 0.0) & (z == 0.0)] = 0.0
    return moved


def write_vector(message: Any, value: Any) -> None:
    """Set x, y, z."""
    message.x, message.y, message.z = (float(part) for part in value)


def write_rotation(message: Any, value: Any) -> None:
    """Set x, y, z, w."""
    message.x, message.y, message.z, message.w = (float(part) for part in value)
