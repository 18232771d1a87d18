"""The sheet of a running service's map."""

from collections import OrderedDict

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap_client import RoughMapClient, Tile
from roughmap_service.exports.cut import Bbox, cells_of, tiles_in
from roughmap_service.exports.sheet import ExportFault, Plane, Sheet

BLOCK_LEVELS = 4
"""A tile so many levels up has 16 x 16 tiles under it: one answer."""

RUN = 16
"""Tiles of a row that are queried together."""

KEPT = 4
"""Answers that are kept."""


class ServedTiles:
    """Tiles of one level, queried when they are needed; `versions` are the states of the map that they came from."""

    def __init__(self, client: RoughMapClient, layers: tuple[str, ...], level: int, cell_size: float) -> None:
        self._client = client
        self._layers = layers
        self._level = level
        self._side = cell_size * TILE_CELLS
        self._runs: OrderedDict[tuple[int, int], dict[int, Tile]] = OrderedDict()
        self.versions: set[tuple[int, int]] = set()

    def listed(self, levels: int) -> npt.NDArray[np.int64]:
        """Return all known tiles, (T, 2), found from the coarse levels down, so that no answer is too large."""
        up = min(levels - 1 - self._level, BLOCK_LEVELS)
        blocks = [tile.key[1:] for tile in self._client.tiles(None, ["count"], level=self._level + up)]
        found = []
        for x, y in blocks:
            side = self._side * (1 << up)
            box = (x * side, y * side, (x + 1) * side, (y + 1) * side)
            found += [tile.key[1:] for tile in self._client.tiles(box, ["count"], level=self._level)]
        return np.array(sorted(set(found)), np.int64).reshape(-1, 2)

    def draw(self, x: int, y: int) -> Plane:
        """Return a tile's layers, (64, 64, L). ExportFault if the service no longer has it."""
        key = x // RUN, y
        if key not in self._runs:
            box = (key[0] * RUN * self._side, y * self._side, (key[0] + 1) * RUN * self._side, (y + 1) * self._side)
            tiles = self._client.tiles(box, self._layers, level=self._level)
            self._runs[key] = {tile.key[1]: tile for tile in tiles if tile.key[2] == y}
            self.versions |= {(tile.epoch, tile.sequence) for tile in tiles}
            if len(self._runs) > KEPT:
                self._runs.popitem(last=False)
        tile = self._runs[key].get(x)
        if tile is None:
            raise ExportFault("the service's map lost tiles meanwhile: it was reset or told to forget; export it again")
        return np.stack([tile[name] for name in self._layers], axis=-1).astype(np.float32, copy=False)


def served_sheet(
    client: RoughMapClient, layers: tuple[str, ...], level: int, bbox: Bbox | None, crs: str | None
) -> tuple[Sheet, ServedTiles]:
    """Return the sheet of a service's map. Its tiles may be of several states if the map changes meanwhile."""
    status = client.status()
    size = status.cell_size * (1 << level)
    if level >= status.levels:
        raise ExportFault(f"--level {level}: the map has the levels 0 to {status.levels - 1}")
    served = ServedTiles(client, layers, level, size)
    tiles = served.listed(status.levels)
    cells = cells_of(tiles, size, bbox)
    title = f"{status.map}, sequence {status.sequence}"
    return Sheet(layers, cells, size, tiles_in(tiles, cells), served.draw, status.frame_id, 0, crs, title), served
