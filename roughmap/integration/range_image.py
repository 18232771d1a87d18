"""The range image of a scan: how far it saw in each direction, seen from one place.

A pixel spans about 0.6 degrees of azimuth and of elevation. Azimuths divide the diamond angle, which takes one division
and no arc tangent; rows divide the tangent of the elevation. A pixel holds the least horizontal distance of its
returns, infinity if it has none: the order of the points does not matter.
"""

import math
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F4, F8, U1, Scalar
from roughmap.cell import PointReason
from roughmap.jit import inline, kernel
from roughmap.points.place import BLOCK

ROWS, AZIMUTHS = 330, 600
RESOLUTION = 0.010471975511965978
"""Height of a row, as a difference of tangents: 0.6 degrees in radians."""

_LOWEST = 1.7320508075688772
"""The first row begins at minus this tangent, that of 60 degrees."""

_NEAREST = 0.1
"""Horizontal distance from which on a return has a direction, metres."""

_SELF = np.uint8(PointReason.SELF)
_PER_QUARTER = AZIMUTHS / 4.0
_FAR = np.float32(math.inf)


class RangeImage(NamedTuple):
    """Memory of an ``image`` and of what `look_around` finds in it."""

    image: F4
    clear_to: F4
    rows: U1


def new_image() -> RangeImage:
    """Allocate it; its pages stay unallocated until they are written."""
    return RangeImage(
        np.empty((AZIMUTHS, ROWS), np.float32), np.empty((AZIMUTHS, ROWS), np.float32), np.zeros(ROWS, np.uint8)
    )


@inline
def row_of(z: Scalar, d: Scalar) -> Scalar:
    """Return the row, before rounding down, of what is ``z`` above the sensor at the horizontal distance ``d``."""
    return (z / d + _LOWEST) / RESOLUTION


@inline
def azimuth_of(x: Scalar, y: Scalar) -> Scalar:
    """Return the azimuth, before rounding down, of a direction in which x and y are not both 0.

    It may be AZIMUTHS, one too many.
    """
    part = x / (abs(x) + abs(y))
    diamond = 1.0 - part if y >= 0.0 else 3.0 + part
    return _PER_QUARTER * diamond


@kernel
def range_image(x: F8, y: F8, z: F8, reason: U1, origin: Scalar, image: F4) -> None:
    """Add points in the map frame, (N,) each, to an ``image`` (AZIMUTHS, ROWS) from ``origin``.

    Every point that has a pose counts, those too that the map does not use.
    """
    pixels, distances = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.float32)
    flat = image.reshape(ROWS * AZIMUTHS)
    for first in range(0, len(x), BLOCK):
        size = min(BLOCK, len(x) - first)
        for k in range(size):  # vectorised
            n = np.uint64(first) + np.uint64(k)
            dx, dy, dz = x[n] - origin[0], y[n] - origin[1], z[n] - origin[2]
            d = math.sqrt(dx * dx + dy * dy)
            row, azimuth = row_of(dz, d), azimuth_of(dx, dy)
            posed = (reason[n] == 0) | (reason[n] >= _SELF)
            seen = posed & (d >= _NEAREST) & (row >= 0.0) & (row < ROWS)
            v = np.int32(row if seen else 0.0)
            u = min(np.int32(azimuth if seen else 0.0), np.int32(AZIMUTHS - 1))
            pixels[k] = u * np.int32(ROWS) + v
            distances[k] = np.float32(d) if seen else _FAR
        for k in range(size):
            pixel = np.uint64(pixels[k])
            flat[pixel] = min(flat[pixel], distances[k])


@kernel
def look_around(image: F4, clear_to: F4, rows: U1) -> None:
    """Find how far the view is clear about each pixel, from the pixel and its eight neighbours.

    ``clear_to`` (AZIMUTHS, ROWS): their least distance, negative if fewer than two of them have a return; minus
    infinity if none has. ``rows`` (ROWS,): whether there is a return in the row or in one next to it, or none in it and
    all rows above: over the highest return the sensor looks into the sky. The first and the last row stay as they are.
    """
    seen = np.zeros(ROWS, np.uint8)
    for u in range(AZIMUTHS):
        west, here, east = image[(u - 1) % AZIMUTHS], image[u], image[(u + 1) % AZIMUTHS]
        out = clear_to[u]
        for v in range(1, ROWS - 1):  # vectorised
            least, number = here[v], np.int32(here[v] < _FAR)
            for value in (
                west[v - 1], west[v], west[v + 1], here[v - 1], here[v + 1], east[v - 1], east[v], east[v + 1],
            ):  # fmt: skip
                least = min(least, value)
                number += np.int32(value < _FAR)
            out[v] = least if number >= 2 else -least
        for v in range(ROWS):
            seen[v] |= np.uint8(here[v] < _FAR)
    highest = 0
    for v in range(ROWS):
        highest = v if seen[v] else highest
    for v in range(1, ROWS - 1):
        rows[v] = np.uint8(1) if v > highest else seen[v - 1] | seen[v] | seen[v + 1]
