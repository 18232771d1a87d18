"""The layers of a map of all points: of each cell's record, and of the eight cells around it."""

import numpy as np

from roughmap.arrays import F8
from roughmap.cell import TILE_CELLS
from roughmap.reading import terrain
from roughmap.reading.cell_values import cell_layers
from roughmap.reading.frozen_tiles import UNKNOWN_TILE, FrozenTiles, children, nine
from roughmap.reading.layers import NEIGHBOUR_LAYERS, PaperLimits

SIZE = TILE_CELLS + 2

SPANS = (
    (slice(0, 1), slice(TILE_CELLS - 1, TILE_CELLS)),
    (slice(1, SIZE - 1), slice(None)),
    (slice(SIZE - 1, SIZE), slice(0, 1)),
)
"""Along one axis: where the tile before, the tile itself and the tile after lie in a plane with a halo, and which of
their cells."""


def neighbour_layers(
    tiles: FrozenTiles, x: int, y: int, names: tuple[str, ...], tolerance: float, limits: PaperLimits
) -> dict[str, F8]:
    """Return ``NEIGHBOUR_LAYERS`` of a tile, traversability only if ``names`` has it."""
    found = {}
    wanted = "traversability" in names
    if wanted and tiles.level > 0:
        least = _traversability(tiles, tiles.level, x, y, tolerance, limits)
        found["traversability"] = np.full((TILE_CELLS, TILE_CELLS), np.nan) if least is None else least.copy()
        wanted = False
    ground = _terrain(tiles, tiles.level, x, y, tolerance, limits if wanted else None)
    return {name: getattr(ground, name) for name in NEIGHBOUR_LAYERS} | found


def _terrain(
    tiles: FrozenTiles, z: int, x: int, y: int, tolerance: float, limits: PaperLimits | None
) -> terrain.Terrain:
    """Return the terrain of a tile, with traversability only if ``limits`` are given."""
    mean = _means(tiles, z, x, y)
    if limits is None:
        return terrain.derive(mean, tiles.side(z))
    cells = tiles.cells(z, x, y)
    names = ("std_dev", "range", "confidence_level")
    spread = cell_layers(UNKNOWN_TILE if cells is None else cells, names, tolerance, 0)
    return terrain.derive(mean, tiles.side(z), limits, *spread.values())


def _traversability(tiles: FrozenTiles, z: int, x: int, y: int, tolerance: float, limits: PaperLimits) -> F8 | None:
    """Return the traversability of a tile of level z: above level 0, the least of its children; None if absent."""
    if z == 0:
        absent = tiles.cells(0, x, y) is None
        return None if absent else _terrain(tiles, 0, x, y, tolerance, limits).traversability

    def make() -> F8:
        return terrain.coarsen_least(
            [_traversability(tiles, z - 1, *child, tolerance, limits) for child in children(x, y)]
        )

    return tiles.cached("traversability", z, x, y, (tolerance, limits), make)


def _means(tiles: FrozenTiles, z: int, x: int, y: int) -> F8:
    """Return the (66, 66) mean heights of a tile with a halo of one cell, NaN where unknown."""
    out = np.full((SIZE, SIZE), np.nan)
    for place, tile in enumerate(nine(x, y)):
        cells = tiles.cells(z, *tile)
        if cells is not None:
            (rows, their_rows), (columns, their_columns) = SPANS[place // 3], SPANS[place % 3]
            part = cells[their_rows, their_columns]
            np.copyto(out[rows, columns], part["mean"], where=part["count"] != 0)
    return out
