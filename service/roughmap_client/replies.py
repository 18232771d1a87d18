"""From replies to arrays. Each reply must be in the contract's form, and all of an answer must show one state of one
map."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import zenoh

from roughmap_client.contract import read_reply
from roughmap_client.errors import IncompleteAnswer, MixedInstances, UnreadableAnswer
from roughmap_client.results import Cells, Region, Tile, Version
from roughmap_client.session import Part
from roughmap_schemas import (
    CellAnswer,
    ContractError,
    Grid,
    TileInfo,
    decode_grid,
    encodings,
    json_encoding,
)
from roughmap_schemas.grid import MAX_DATA
from roughmap_schemas.layers import LAYERS
from roughmap_schemas.messages import Reply

R = TypeVar("R", bound=Reply)

TILE_CELLS = 64
"""Cells along a tile's side, as in the contract; repeated here so that a client need not load the kernels."""


TILE_BYTES = TILE_CELLS * TILE_CELLS * 8 * len(LAYERS)
"""All layers of a tile as float64. A few compressed bytes can claim to unpack to more; such a tile is refused."""


def read_region(part: Part, layers: Sequence[str]) -> Region:
    """Return the region in the one reply to a region query."""
    info, grid = _grid(part, layers)
    return Region(grid.layers, grid.origin, grid.cell_size, info)


def read_tiles(parts: Sequence[Part], layers: Sequence[str]) -> list[Tile]:
    """Return the tiles of all replies to a query, ascending by key; raises MixedInstances or IncompleteAnswer unless
    they are one whole answer."""
    tiles = sorted((_tile(part, layers) for part in parts), key=lambda tile: tile.key)
    instances = {tile.info.instance for tile in tiles}
    if len(instances) > 1:
        raise MixedInstances(f"{len(instances)} services answered: {', '.join(sorted(instances))}")
    if len({tile.version for tile in tiles}) > 1:
        raise IncompleteAnswer("the tiles show different states of the map; ask again")
    if tiles and not tiles[0].info.answer_tiles == len(tiles) == len({tile.key for tile in tiles}):
        raise IncompleteAnswer(f"{len(tiles)} of {tiles[0].info.answer_tiles} tiles arrived; ask again")
    return tiles


def read_update(sample: zenoh.Sample) -> Tile:
    """Return the tile of an update."""
    attachment = sample.attachment
    part = Part(
        key=str(sample.key_expr),
        payload=sample.payload.to_bytes(),
        attachment=b"" if attachment is None else attachment.to_bytes(),
        encoding=str(sample.encoding),
        replier="",
    )
    return _tile(part, ())


def read_cells(part: Part, layers: Sequence[str], number: int) -> Cells:
    """Return the cells in the reply to a cells query about ``number`` places."""
    answer = read_model(part, CellAnswer)
    cells = answer.cells
    if len(cells) != number:
        raise UnreadableAnswer(f"{part.key}: expected {number} cells; found {len(cells)}")
    missing = [name for name in layers if any(name not in cell.layers for cell in cells)]
    if missing:
        raise UnreadableAnswer(f"{part.key}: layers missing: {', '.join(missing)}")
    return Cells(
        i=np.array([cell.i for cell in cells], np.int64),
        j=np.array([cell.j for cell in cells], np.int64),
        states=[cell.state for cell in cells],
        layers={name: _floats([cell.layers[name] for cell in cells]) for name in layers},
        instance=answer.instance,
        version=Version(answer.epoch, answer.sequence, answer.instance),
    )


def read_model(part: Part, kind: type[R]) -> R:
    """Return a JSON reply as a ``kind``."""
    part.check_encoding(json_encoding(kind.__name__))
    try:
        return read_reply(kind, part.payload)
    except ContractError as error:
        raise UnreadableAnswer(f"{part.key}: {error}") from None


def _floats(values: Sequence[float | None]) -> "np.ndarray[tuple[int, ...], np.dtype[np.float64]]":
    """Return the values as an array, NaN for null."""
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _tile(part: Part, layers: Sequence[str]) -> Tile:
    info, grid = _grid(part, layers, TILE_BYTES)
    if info.x is None or info.y is None:
        raise UnreadableAnswer(f"{part.key}: expected a tile with its numbers; found x {info.x}, y {info.y}")
    shape = next(iter(grid.layers.values())).shape
    if shape != (TILE_CELLS, TILE_CELLS):
        raise UnreadableAnswer(f"{part.key}: expected {TILE_CELLS} x {TILE_CELLS} cells; found {shape}")
    return Tile(grid.layers, grid.origin, grid.cell_size, info)


def _grid(part: Part, layers: Sequence[str], most: int = MAX_DATA) -> tuple[TileInfo, Grid]:
    """Return attachment and grid. ``layers`` are the expected ones; empty accepts any."""
    part.check_encoding(encodings.GRID)
    try:
        info = read_reply(TileInfo, part.attachment)
        grid = decode_grid(part.payload, info.compression, max_data=most)
    except ContractError as error:
        raise UnreadableAnswer(f"{part.key}: {error}") from None
    if layers and tuple(grid.layers) != tuple(layers):
        raise UnreadableAnswer(f"{part.key}: expected layers {', '.join(layers)}; found {', '.join(grid.layers)}")
    return info, grid
