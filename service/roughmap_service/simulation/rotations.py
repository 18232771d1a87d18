"""Quaternions (x, y, z, w) of what simulation and recordings hold: small turns and matrices."""

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Quaternion = tuple[float, float, float, float]


def of_vector(vector: Floats) -> Quaternion:
    """Exp(vector): the rotation about it by its length, in radians."""
    angle = float(np.linalg.norm(vector))
    scale = math.sin(0.5 * angle) / angle if angle > 0 else 0.5
    x, y, z = (scale * float(part) for part in vector)
    return x, y, z, math.cos(0.5 * angle)


def of_matrix(matrix: Floats) -> Quaternion:
    """The unit quaternion of a (3, 3) rotation, which may be rounded.

    Of the four squares 4 x^2 .. 4 w^2, which the diagonal gives, the largest is divided by: it is 1 at least.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
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
