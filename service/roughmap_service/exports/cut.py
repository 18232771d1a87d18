"""Which cells of the map become a sheet."""

import math

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap.reading.region import CELL_SLACK
from roughmap_service.exports.sheet import CellBox, ExportFault

Bbox = tuple[float, float, float, float]


def cells_of(tiles: npt.NDArray[np.int64], cell_size: float, bbox: Bbox | None) -> CellBox:
    """Return the cells i0, j0, i1, j1 that a box in metres covers, or all of the tiles (T, 2); half-open.

    ExportFault if there is nothing in them.
    """
    if not len(tiles):
        raise ExportFault("the map is empty: there is nothing to export")
    (x0, y0), (x1, y1) = tiles.min(axis=0).tolist(), tiles.max(axis=0).tolist()
    whole = x0 * TILE_CELLS, y0 * TILE_CELLS, (x1 + 1) * TILE_CELLS, (y1 + 1) * TILE_CELLS
    if bbox is None:
        return whole
    low = [math.floor(value / cell_size + CELL_SLACK) for value in bbox[:2]]
    high = [math.ceil(value / cell_size - CELL_SLACK) for value in bbox[2:]]
    if not len(tiles_in(tiles, (low[0], low[1], high[0], high[1]))):
        known = ", ".join(f"{cell * cell_size:.10g}" for cell in whole)
        raise ExportFault(f"nothing is known in --bbox; the map's tiles lie in {known}")
    return low[0], low[1], high[0], high[1]


def tiles_in(tiles: npt.NDArray[np.int64], cells: CellBox) -> npt.NDArray[np.int64]:
    """Return the tiles (T, 2) that meet a rectangle of cells."""
    i0, j0, i1, j1 = cells
    low, high = (i0 // TILE_CELLS, j0 // TILE_CELLS), (-(-i1 // TILE_CELLS), -(-j1 // TILE_CELLS))
    inside: npt.NDArray[np.int64] = tiles[((tiles >= low) & (tiles < high)).all(axis=1)]
    return inside
