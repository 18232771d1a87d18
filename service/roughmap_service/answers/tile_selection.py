"""Which tiles a tile query selects: by its key expression, by its bbox, or both."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap.cell import TILE_CELLS
from roughmap.tiles.index import TILE_LIMIT, TileBox
from roughmap_schemas.keys import Keys, Selected
from roughmap_schemas.selectors import Bbox
from roughmap_service.answers.plan import INT32


@dataclass(frozen=True, slots=True)
class SelectedKeys:
    """The tiles that a key expression selects: level, x and y (None: any), and a pattern where these say too little."""

    level: int | None
    x: int | None
    y: int | None
    pattern: zenoh.KeyExpr | None
    """A key expression that the key of each tile must intersect as well; None: no such condition."""


def selected_keys(keys: Keys, levels: int, key: str) -> SelectedKeys:
    """Parse the key expression of a tile query; raise QueryFault (``bad_key``, ``bad_level``)."""
    form = keys.form("tiles")
    parts = key.split("/")
    if "**" in parts:
        return SelectedKeys(None, None, None, zenoh.KeyExpr(key))
    pattern = None
    if len(parts) == len(form.chunks):
        # Zenoh routed the query here, so the other chunks match; only those in the numbers' places count.
        parts = [part if chunk.startswith("{") else chunk for chunk, part in zip(form.chunks, parts, strict=True)]
        # A chunk such as 1$* selects any number first, then the pattern narrows it; any other chunk must be a number.
        whole = ["*" if "$*" in part else part for part in parts]
        pattern = zenoh.KeyExpr(key) if whole != parts else None
        key = "/".join(whole)
    selected: Selected = keys.parse_tile_selector(key, levels)
    return SelectedKeys(*selected, pattern)


def selected_box(x: int | None, y: int | None, bbox: Bbox | None, cell_size: float) -> TileBox | None:
    """Return the tiles x0, y0, x1, y1, inclusive, that a key and a bbox select together; None: all tiles. If there are
    none, x0 > x1 or y0 > y1."""
    if x is None and y is None and bbox is None:
        return None
    x0 = y0 = -TILE_LIMIT
    x1 = y1 = TILE_LIMIT - 1
    if bbox is not None:
        edge = INT32 * cell_size  # no cell lies beyond
        clipped = [min(max(value, -edge), edge) for value in bbox]
        bx0, by0, bx1, by1 = _tile_range((clipped[0], clipped[1], clipped[2], clipped[3]), cell_size)
        x0, y0, x1, y1 = max(x0, bx0), max(y0, by0), min(x1, bx1), min(y1, by1)
    if x is not None:
        x0, x1 = max(x0, x), min(x1, x)
    if y is not None:
        y0, y1 = max(y0, y), min(y1, y)
    return x0, y0, x1, y1


def within(tiles: npt.NDArray[np.int32], box: TileBox | None) -> npt.NDArray[np.int32]:
    """Return the rows of the (T, 2) tiles that lie in a box."""
    if box is None or not len(tiles):
        return tiles
    inside = (tiles >= np.array(box[:2])).all(axis=1) & (tiles <= np.array(box[2:])).all(axis=1)
    return tiles[inside]


def _tile_range(bbox: Bbox, cell_size: float) -> TileBox:
    """Return the tiles x0, y0, x1, y1, inclusive, whose half-open extent meets a box in metres.

    The box is half-open too, like a region and the map's bounds: a box that ends where a tile begins does not meet it.
    Edges are products, k * side; quotients would round differently.
    """
    xmin, ymin, xmax, ymax = bbox
    side = TILE_CELLS * cell_size
    return _first(xmin, side), _first(ymin, side), _last(xmax, side), _last(ymax, side)


def _first(low: float, side: float) -> int:
    """Return the first tile that ends above ``low``."""
    tile = math.floor(low / side)
    while (tile + 1) * side <= low:
        tile += 1
    while tile * side > low:
        tile -= 1
    return tile


def _last(high: float, side: float) -> int:
    """Return the last tile that begins below ``high``."""
    tile = math.ceil(high / side) - 1
    while tile * side >= high:
        tile -= 1
    while (tile + 1) * side < high:
        tile += 1
    return tile
