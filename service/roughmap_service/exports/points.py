"""The known cells as points: centres of cells at their mean height, with the layers as numbers."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_service.exports.sheet import Sheet

COUNT_DIGITS = 12
"""The number of points is known at the end, and headers have room for so many digits."""

NEAR = 5000.0
"""Metres from zero within which float32 keeps a quarter of a millimetre."""


class CellPoints(NamedTuple):
    """The known cells of a tile: `places` (N, 3) float64 in the map frame, metres; `values` (N, L) float32."""

    places: npt.NDArray[np.float64]
    values: npt.NDArray[np.float32]


def cell_points(sheet: Sheet) -> Iterator[CellPoints]:
    """Yield the known cells tile by tile. The sheet must have mean_height first; its values are the other layers."""
    x0, y0, s = sheet.cells[0], sheet.cells[1], sheet.cell_size
    for part in sheet.parts():
        heights = part.values[:, :, 0]
        j, i = np.nonzero(np.isfinite(heights))
        places = np.empty((len(i), 3))
        places[:, 0] = (x0 + part.i + i + 0.5) * s
        places[:, 1] = (y0 + part.j + j + 0.5) * s
        places[:, 2] = heights[j, i]
        yield CellPoints(places, part.values[j, i, 1:])


def local_origin(sheet: Sheet) -> tuple[float, float]:
    """Return the origin about which float32 keeps millimetres: 0, or the sheet's middle to 100 m if that is far off."""
    (x0, y0), (x1, y1) = sheet.low, sheet.high
    if max(abs(x0), abs(y0), abs(x1), abs(y1)) < NEAR:
        return 0.0, 0.0
    return round((x0 + x1) / 2, -2), round((y0 + y1) / 2, -2)
