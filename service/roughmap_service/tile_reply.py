"""A tile, or a region, as readers get it: a foxglove.Grid and what it is a state of."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.frozen import Frozen
from roughmap.region import read_region, tile_box
from roughmap_schemas.grid import encode_grid
from roughmap_schemas.messages import TileInfo, model_bytes

Plane = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Identity:
    """Who answers: one process that serves one run of one map, with the settings that shape its cells."""

    map: str
    run: str
    instance: str
    configuration_digest: str
    frame_id: str


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a reader wants to be told of each cell, and in which form."""

    layers: tuple[str, ...]
    tolerance: float
    limits: Mapping[str, float]
    dtype: Literal["f4", "f8"] = "f4"
    compression: Literal["zstd"] | None = None


@dataclass(frozen=True, slots=True)
class TileReply:
    """Payload and attachment of one reply or update."""

    payload: bytes
    attachment: bytes
    info: TileInfo


def tile_reply(
    frozen: Frozen, x: int, y: int, sequence: int, wanted: Wanted, identity: Identity, epoch: int, answer_tiles: int
) -> TileReply:
    """The reply of tile (x, y) of the level of ``frozen``; ``sequence`` is the tile's own.

    A tile without a known cell answers too (all unknown, known_cells 0): one that a reset emptied.
    """
    layers = frozen.tile_layers(x, y, wanted.layers, wanted.tolerance, wanted.limits)
    known_cells = frozen.known_cells(x, y)
    oldest_ns, newest_ns = frozen.stamps(x, y) if known_cells else (0, 0)
    info = TileInfo(
        map=identity.map,
        instance=identity.instance,
        epoch=epoch,
        z=frozen.level,
        x=x,
        y=y,
        sequence=sequence,
        map_sequence=frozen.sequence,
        answer_tiles=answer_tiles,
        oldest_ns=oldest_ns,
        newest_ns=newest_ns,
        known_cells=known_cells,
        digest=frozen.digest(x, y),
        configuration_digest=identity.configuration_digest,
        compression=wanted.compression,
    )
    origin = (x * TILE_CELLS * frozen.cell_size, y * TILE_CELLS * frozen.cell_size)
    return _reply(layers, origin, frozen.cell_size, wanted, identity, info)


def region_reply(
    frozen: Frozen, bbox: tuple[float, float, float, float], wanted: Wanted, identity: Identity, epoch: int
) -> TileReply:
    """One Grid over the cells that ``bbox`` covers; ``frozen`` must hold their tiles.

    Its stamps and its sequence are those of the tiles that it touches.
    """
    region = read_region(frozen, bbox, dict.fromkeys((*wanted.layers, "count")), wanted.tolerance, wanted.limits)
    x0, y0, x1, y1 = tile_box(region.cells)
    inside = (frozen.tiles >= (x0, y0)).all(axis=1) & (frozen.tiles <= (x1, y1)).all(axis=1)
    stamps = [frozen.stamps(x, y) for x, y in frozen.tiles[inside].tolist()]
    info = TileInfo(
        map=identity.map,
        instance=identity.instance,
        epoch=epoch,
        z=frozen.level,
        x=None,
        y=None,
        sequence=int(frozen.sequences[inside].max(initial=0)),
        map_sequence=frozen.sequence,
        answer_tiles=1,
        oldest_ns=min((oldest for oldest, _ in stamps), default=0),
        newest_ns=max((newest for _, newest in stamps), default=0),
        known_cells=int(np.count_nonzero(region["count"])),
        digest=None,
        configuration_digest=identity.configuration_digest,
        compression=wanted.compression,
    )
    layers = {name: region[name] for name in wanted.layers}
    return _reply(layers, region.origin, region.cell_size, wanted, identity, info)


def _reply(
    layers: Mapping[str, Plane],
    origin: tuple[float, float],
    cell_size: float,
    wanted: Wanted,
    identity: Identity,
    info: TileInfo,
) -> TileReply:
    payload = encode_grid(
        {name: layers[name] for name in wanted.layers},
        origin,
        cell_size,
        info.newest_ns,
        identity.frame_id,
        dtype=wanted.dtype,
        compression=wanted.compression,
    )
    return TileReply(payload, model_bytes(info), info)


def tile_range(bbox: tuple[float, float, float, float], cell_size: float) -> tuple[int, int, int, int]:
    """The tiles (x0, y0, x1, y1), inclusive, whose half-open extent meets a box in metres.

    The box is taken as half-open too, as `region` and the map's bounds are: a box that ends where a tile begins doesn't
    meet it. Edges are the products of section 3, not quotients.
    """
    xmin, ymin, xmax, ymax = bbox
    side = TILE_CELLS * cell_size
    return _first(xmin, side), _first(ymin, side), _last(xmax, side), _last(ymax, side)


def _first(low: float, side: float) -> int:
    """The first tile that ends beyond ``low``."""
    tile = math.floor(low / side)
    while (tile + 1) * side <= low:
        tile += 1
    while tile * side > low:
        tile -= 1
    return tile


def _last(high: float, side: float) -> int:
    """The last tile that begins before ``high``."""
    tile = math.ceil(high / side) - 1
    while tile * side >= high:
        tile -= 1
    while (tile + 1) * side < high:
        tile += 1
    return tile


TILE_LIMIT = 2**31 >> TILE_SHIFT
"""Tiles are numbered from minus this up to, not including, this: their cells are int32."""
