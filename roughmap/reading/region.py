"""A rectangle of the map as arrays: the cells that a box covers, and the layers over them."""

from collections.abc import Iterable, Iterator, Mapping
from math import ceil, floor, isfinite

import numpy as np

from roughmap.arrays import F8
from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.reading.frozen import FrozenMap
from roughmap.reading.layers import unknown_value

Bbox = tuple[float, float, float, float]
CellBox = tuple[int, int, int, int]

MAX_CELLS = 1 << 26
"""Half a gigabyte per layer in float64. Larger regions must be read in pieces."""

CELL_SLACK = 1e-6
"""In cells; keeps an edge such as 0.3 / 0.1 = 2.9999999999999996 on its cell border."""


class Region(Mapping[str, F8]):
    """Layers over a rectangle of cells by name: (ny, nx) float64, row 0 at the lowest y, column 0 at the lowest x."""

    def __init__(
        self, layers: Mapping[str, F8], *, cells: CellBox, cell_size: float, sequence: int, level: int
    ) -> None:
        self._layers = dict(layers)
        self.cells = cells
        """(i0, j0, i1, j1) of the level, half-open."""
        self.cell_size = cell_size
        """Side of a cell of the level, in metres."""
        self.origin = (cells[0] * cell_size, cells[1] * cell_size)
        """x and y of the lower-left corner, in metres."""
        self.sequence = sequence
        """Sequence of the map, the same for all layers."""
        self.level = level

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        i0, j0, i1, j1 = self.cells
        return j1 - j0, i1 - i0

    def __getitem__(self, name: str) -> F8:
        return self._layers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._layers)

    def __len__(self) -> int:
        return len(self._layers)


def cell_box(bbox: Iterable[float], cell_size: float) -> CellBox:
    """Return the cells (i0, j0, i1, j1), half-open, that the box (xmin, ymin, xmax, ymax) in metres covers.

    Along x from floor(xmin / s + 1e-6) up to, not including, ceil(xmax / s - 1e-6); along y likewise. ValueError for a
    box that is not four finite numbers, is empty, or covers more than 2^26 cells.
    """
    box = tuple(float(value) for value in bbox)
    if len(box) != 4:
        raise ValueError(f"the box has {len(box)} numbers; expected four: xmin, ymin, xmax, ymax in metres")
    if not all(isfinite(value / cell_size) for value in box):
        raise ValueError(f"the box is {box}; expected finite numbers of metres")
    xmin, ymin, xmax, ymax = (value / cell_size for value in box)
    i0, j0 = floor(xmin + CELL_SLACK), floor(ymin + CELL_SLACK)
    i1, j1 = ceil(xmax - CELL_SLACK), ceil(ymax - CELL_SLACK)
    if not (xmin < xmax and ymin < ymax):
        raise ValueError(f"the box {box} is empty; expected xmin < xmax and ymin < ymax")
    if not (i0 < i1 and j0 < j1):
        raise ValueError(f"the box {box} covers no cell: it is too narrow for cells of {cell_size} m")
    cells = (i1 - i0) * (j1 - j0)
    if cells > MAX_CELLS:
        raise ValueError(f"the box {box} covers {cells} cells of {cell_size} m; expected at most {MAX_CELLS}")
    return i0, j0, i1, j1


def tile_box(cells: CellBox) -> CellBox:
    """Return the tiles (x0, y0, x1, y1), inclusive, that contain these half-open cells."""
    i0, j0, i1, j1 = cells
    return i0 >> TILE_SHIFT, j0 >> TILE_SHIFT, (i1 - 1) >> TILE_SHIFT, (j1 - 1) >> TILE_SHIFT


def read_region(
    frozen: FrozenMap,
    bbox: Iterable[float],
    names: Iterable[str],
    height_tolerance: float = 0.05,
    limits: Mapping[str, float] | None = None,
) -> Region:
    """Read the layers ``names`` over ``bbox`` (xmin, ymin, xmax, ymax in metres) at the level of ``frozen``.

    Layers that need neighbours use cells outside the box too. ValueError for a box that ``cell_box`` refuses or
    ``frozen`` does not cover, an unknown layer or limit, and a tolerance that is not positive.
    """
    names = frozen.check(names, height_tolerance, limits)
    cells = cell_box(bbox, frozen.cell_size)
    tiles = tile_box(cells)
    if not frozen.covers(tiles):
        raise ValueError(f"the box covers the tiles {tiles}; expected tiles within {frozen.box}")
    i0, j0, i1, j1 = cells
    layers = {name: np.full((j1 - j0, i1 - i0), unknown_value(name)) for name in names}
    (x0, y0, x1, y1), (tx, ty) = tiles, frozen.tiles.T
    for x, y in frozen.tiles[(tx >= x0) & (tx <= x1) & (ty >= y0) & (ty <= y1)].tolist():
        across, columns = overlap(x, i0, i1)
        up, rows = overlap(y, j0, j1)
        for name, plane in frozen.tile_layers(x, y, names, height_tolerance, limits).items():
            layers[name][up, across] = plane[rows, columns]
    return Region(layers, cells=cells, cell_size=frozen.cell_size, sequence=frozen.sequence, level=frozen.level)


def overlap(tile: int, first: int, end: int) -> tuple[slice, slice]:
    """Return the overlap of a tile with the cells [first, end) along one axis, as slices of the cells and the tile."""
    low, high = max(tile * TILE_CELLS, first), min((tile + 1) * TILE_CELLS, end)
    return slice(low - first, high - first), slice(low - tile * TILE_CELLS, high - tile * TILE_CELLS)
