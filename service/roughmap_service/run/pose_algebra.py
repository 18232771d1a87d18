"""Rotations and distances of a few poses, in plain IEEE floats, so that what is decided by them is the same anywhere.

With BLAS, and with functions of the C library other than `sqrt`, the last bit could depend on the machine.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roughmap.points.poly import angle
from roughmap_schemas.geometry import Matrix, Quaternion, Vector, multiply

Floats = npt.NDArray[np.float64]


def triple(values: Sequence[float] | Floats) -> Vector:
    """Three numbers as plain floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def quaternion(values: Sequence[float] | Floats) -> Quaternion:
    """Four numbers, the last of them w, as plain floats."""
    x, y, z, w = (float(v) for v in values)
    return x, y, z, w


def rotate(r: Matrix, v: Vector) -> Vector:
    """r v."""
    x, y, z = (row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in r)
    return x, y, z


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Distance of two points; infinite from 1e154 on, whose square overflows."""
    total = 0.0
    for p, q in zip(a, b, strict=True):
        total += (q - p) * (q - p)
    return math.sqrt(total)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Angle in radians of the shorter turn from a to b."""
    near = distance(a, b)
    far = distance(a, [-v for v in b])
    return 4.0 * float(angle(max(near, far), min(near, far)))


def rotation_vector(a: Quaternion, b: Quaternion) -> Vector:
    """The shorter turn from a to b, its angle times its axis, in the parent frame's axes."""
    x, y, z, w = multiply(b, (-a[0], -a[1], -a[2], a[3]))
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    factor = 2.0 * float(angle(abs(w), sine)) / sine * (1.0 if w >= 0.0 else -1.0)
    return x * factor, y * factor, z * factor


def turn_covariance(r: Matrix, covariance: Floats) -> Floats:
    """A (6, 6) covariance whose axes are turned by r: each 3x3 block b becomes r b r^T."""
    c = covariance.tolist()
    out = np.empty((6, 6))
    for i0 in (0, 3):
        for j0 in (0, 3):
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        row = c[i0 + k]
                        inner = row[j0] * r[j][0] + row[j0 + 1] * r[j][1] + row[j0 + 2] * r[j][2]
                        total += r[i][k] * inner
                    out[i0 + i, j0 + j] = total
    lower = np.tril_indices(6, -1)
    out[lower] = out.T[lower]
    return out
