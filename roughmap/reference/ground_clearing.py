"""What a scan saw through: hits in columns are halved where its beams passed. In plain Python, over dictionaries."""

import math
from typing import Any

import numpy as np

from roughmap.arrays import F8, U1
from roughmap.cell import BASED, PointReason
from roughmap.reference.ground import Cells

RESOLUTION = 0.010471975511965978
"""Side of a pixel, 0.6 degrees in radians: of a row in the tangent of the elevation, about."""

LOWEST = 1.7320508075688772
"""Tangent of 60 degrees, how far below the horizon the image begins."""

ROWS, COLUMNS = 330, 600

NEAREST_RETURN, NEAREST_CELL = 0.1, 0.5
"""Horizontal distances, metres."""

MARGIN = 0.3
"""Metres. A return must be so much farther than a cell to have passed it."""

_PLACED = {
    PointReason.KEPT, PointReason.SELF, PointReason.RANGE, PointReason.CEILING, PointReason.COVARIANCE,
    PointReason.UNCERTAIN, PointReason.BOUNDS,
}  # fmt: skip
"""Returns of which the place is known: each says that its beam was free."""


def range_image(x: F8, y: F8, z: F8, reason: U1, origin: tuple[float, float, float]) -> Any:
    """Return the (ROWS, COLUMNS) float32 horizontal distances of the nearest returns, infinite where there is none.

    ``x``, ``y``, ``z``, ``reason`` (N,): points in the map frame. ``origin``: the sensor there.
    """
    image = np.full((ROWS, COLUMNS), np.inf, np.float32)
    for px, py, pz, why in zip(x.tolist(), y.tolist(), z.tolist(), reason.tolist(), strict=True):
        dx, dy, dz = px - origin[0], py - origin[1], pz - origin[2]
        d = math.sqrt(dx * dx + dy * dy)
        if why not in _PLACED or not NEAREST_RETURN <= d < math.inf or not math.isfinite(dz):
            continue
        row, column = _pixel(dx, dy, dz, d)
        if 0 <= row < ROWS:
            image[row, column] = min(image[row, column], np.float32(d))
    return image


def clear_cells(cells: Cells, image: Any, origin: tuple[float, float, float], a: float) -> int:
    """Halve the hits of the ``cells`` (of side ``a``) that the image was seen through; return how many changed.

    A cell is judged as far away as it is as wide as a pixel.
    """
    halved = 0
    for (i, j), cell in cells.items():
        dx, dy = (i + 0.5) * a - origin[0], (j + 0.5) * a - origin[1]
        d = math.sqrt(dx * dx + dy * dy)
        if not cell.flags & BASED or not NEAREST_CELL <= d <= a / RESOLUTION:
            continue
        for k, hits in enumerate(cell.bins):
            z = (2 * cell.base + k + 0.5) * 0.05
            if hits and _is_seen_through(image, *_pixel(dx, dy, z - origin[2], d), d):
                cell.bins[k] = hits // 2
                halved += 1
    return halved


def _is_seen_through(image: Any, row: int, column: int, d: float) -> bool:
    """Whether at least two returns lie around a pixel, and all of them well behind distance ``d``."""
    if not 1 <= row < ROWS - 1:
        return False
    around = [float(image[r, c % COLUMNS]) for r in range(row - 1, row + 2) for c in range(column - 1, column + 2)]
    return min(around) >= d + MARGIN and sum(value < math.inf for value in around) >= 2


def _pixel(dx: float, dy: float, dz: float, d: float) -> tuple[int, int]:
    """Return row and column of a direction; the row may lie outside the image."""
    return math.floor((dz / d + LOWEST) / RESOLUTION), min(math.floor(150.0 * _diamond(dx, dy)), COLUMNS - 1)


def _diamond(dx: float, dy: float) -> float:
    """Return the diamond angle of a direction in [0, 4): 0 along x, 1 along y, by one division."""
    part = dx / (abs(dx) + abs(dy))
    return 1.0 - part if dy >= 0.0 else 3.0 + part
