"""Positions and rotations of one frame in another, in plain floats."""

import math
from typing import Final, NamedTuple

from roughmap_schemas.geometry import Quaternion, Vector, multiply, rotation_matrix

SMALL_ANGLE: Final = 1e-6
"""Below this angle of two unit quaternions, sines are replaced by angles: they agree to 2e-13."""


class Rigid(NamedTuple):
    """The pose of a child frame in its parent: metres, and a unit quaternion x, y, z, w."""

    translation: Vector
    rotation: Quaternion


IDENTITY: Final = Rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def rotate(rotation: Quaternion, v: Vector) -> Vector:
    """Return a vector of the child frame in the parent's axes."""
    (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(rotation)
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def unit(x: float, y: float, z: float, w: float) -> Quaternion:
    """Return a quaternion with norm 1; the norm that is given must not be 0."""
    n = math.sqrt(x * x + y * y + z * z + w * w)
    return x / n, y / n, z / n, w / n


def compose(a: Rigid, b: Rigid) -> Rigid:
    """Return the pose in a's parent of what b gives in a's child."""
    x, y, z = rotate(a.rotation, b.translation)
    tx, ty, tz = a.translation
    return Rigid((tx + x, ty + y, tz + z), multiply(a.rotation, b.rotation))


def inverse(a: Rigid) -> Rigid:
    """Return the pose of the parent in the child."""
    x, y, z, w = a.rotation
    back = (-x, -y, -z, w)
    x, y, z = rotate(back, a.translation)
    return Rigid((-x, -y, -z), back)


def between(a: Rigid, b: Rigid, share: float) -> Rigid:
    """Return the pose at this share of the way from a to b: straight on, and turning evenly the shorter way."""
    ax, ay, az = a.translation
    bx, by, bz = b.translation
    keep = 1.0 - share
    translation = (keep * ax + share * bx, keep * ay + share * by, keep * az + share * bz)
    return Rigid(translation, _slerp(a.rotation, b.rotation, share))


def _slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    apart = math.dist(a, b)
    sign = 1.0
    near, far = apart, math.hypot(*(p + q for p, q in zip(a, b, strict=True)))
    if near > far:
        near, far, sign = far, near, -1.0
    angle = 2.0 * math.atan2(near, far)
    if angle < SMALL_ANGLE:
        of_a, of_b = 1.0 - share, share
    else:
        of_a, of_b = math.sin((1.0 - share) * angle), math.sin(share * angle)
    of_b *= sign
    x, y, z, w = (of_a * p + of_b * q for p, q in zip(a, b, strict=True))
    return unit(x, y, z, w)


def differ(a: Rigid, b: Rigid, metres: float, radians: float) -> bool:
    """Return whether two poses are farther apart than the given, in position or in rotation."""
    far = math.dist(a.translation, b.translation)
    p, q = a.rotation, b.rotation
    chord = min(math.dist(p, q), math.hypot(*(s + t for s, t in zip(p, q, strict=True))))
    return far > metres or 2.0 * chord > radians


def is_finite(a: Rigid) -> bool:
    """Return whether all numbers are finite: sums of the largest numbers may not be."""
    return all(map(math.isfinite, (*a.translation, *a.rotation)))
