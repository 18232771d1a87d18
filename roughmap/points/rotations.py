"""Unit quaternions x, y, z, w and their rotation matrices."""

import numpy as np

from roughmap.arrays import F8, Scalar
from roughmap.jit import inline, kernel

MIN_QUATERNION_NORM = 1e-6
"""A quaternion with a smaller norm defines no rotation and is refused."""


@inline
def rotation_matrix(x: Scalar, y: Scalar, z: Scalar, w: Scalar) -> Scalar:
    """Return the nine entries of the rotation matrix of a unit quaternion, row by row."""
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
    """Return the same for a quaternion in an array (4,); callable from Python."""
    return rotation_matrix(rotation[0], rotation[1], rotation[2], rotation[3])


def unit_quaternions(rotation: F8, name: str) -> F8:
    """Normalise (M, 4) quaternions. ValueError if a norm is below 1e-6."""
    x, y, z, w = rotation.T
    # Divide by the largest component first, so that no square overflows or underflows.
    largest = np.maximum(np.maximum(abs(x), abs(y)), np.maximum(abs(z), abs(w)))
    if (largest < MIN_QUATERNION_NORM / 2).any():
        raise ValueError(f"{name}: expected quaternions x, y, z, w of norm at least {MIN_QUATERNION_NORM}")
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if (norm * largest < MIN_QUATERNION_NORM).any():
        raise ValueError(f"{name}: expected quaternions x, y, z, w of norm at least {MIN_QUATERNION_NORM}")
    return np.ascontiguousarray(np.stack([x / norm, y / norm, z / norm, w / norm], axis=1))
