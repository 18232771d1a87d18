"""A tile, or a region, as readers get it: a foxglove.Grid and what it is a state of."""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap.reading.frozen import FrozenMap
from roughmap.reading.layers import ZERO_WHERE_UNKNOWN
from roughmap.reading.region import CellBox, overlap, tile_box
from roughmap_schemas.grid import Compression, encode_grid, encode_packed, packed_data
from roughmap_schemas.messages import TileInfo, model_bytes
from roughmap_service.answers.tile_cache import DrawnTile, TileCache, drawn_tile


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
    compression: Compression = None

    @property
    def key(self) -> Hashable:
        """Equal for those that want the same."""
        return self.layers, self.tolerance, tuple(sorted(self.limits.items())), self.dtype, self.compression


@dataclass(frozen=True, slots=True)
class TileReply:
    """Payload and attachment of one reply or update."""

    payload: bytes
    attachment: bytes


class NotDrawnYet(Exception):
    """A tile of a map that is not there to be read any more, and that the cache doesn't hold."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawable:
    """The tiles that a level had, without their cells: for those that are drawn already."""

    level: int
    cell_size: float
    sequence: int
    newest_updated: int
    tiles: npt.NDArray[np.int32]
    sequences: npt.NDArray[np.int64]


class Drawing:
    """Draws tiles of one state of the map, at one level, in one form; those that ``cache`` holds are not drawn again.

    Where only `Drawable` is left of that state, `NotDrawnYet` is raised for the others.
    """

    def __init__(
        self,
        frozen: FrozenMap | Drawable,
        epoch: int,
        wanted: Wanted,
        identity: Identity,
        cache: TileCache | None = None,
    ) -> None:
        self.frozen = frozen
        self.epoch = epoch
        self.wanted = wanted
        self.identity = identity
        self._cache = cache
        # A tile's layers are as old as its sequence, but for the ages, which count from the map's newest point.
        now = frozen.newest_updated if "age" in wanted.layers else None
        self._key = epoch, frozen.level, wanted.key, now

    def tile(self, x: int, y: int, sequence: int) -> DrawnTile:
        """Tile (x, y), whose own sequence is ``sequence``; all unknown if there is none."""
        if self._cache is None:
            return self._draw(x, y, sequence)
        return self._cache.get((x, y, sequence, self._key), lambda: self._draw(x, y, sequence))

    def reply(self, x: int, y: int, sequence: int, answer_tiles: int) -> TileReply:
        """The same as one of so many replies.

        A tile without a known cell answers too (all unknown, known_cells 0): one that a reset emptied.
        """
        drawn = self.tile(x, y, sequence)
        return TileReply(drawn.payload, drawn.told(self.frozen.sequence, answer_tiles))

    def _draw(self, x: int, y: int, sequence: int) -> DrawnTile:
        frozen, wanted = self.frozen, self.wanted
        if isinstance(frozen, Drawable):
            raise NotDrawnYet
        layers = frozen.tile_layers(x, y, wanted.layers, wanted.tolerance, wanted.limits)
        known = frozen.records(x, y)["count"] != 0
        known_cells = int(np.count_nonzero(known))
        oldest_ns, newest_ns = frozen.stamps(x, y) if known_cells else (0, 0)
        payload = encode_grid(
            layers,
            (x * TILE_CELLS * frozen.cell_size, y * TILE_CELLS * frozen.cell_size),
            frozen.cell_size,
            newest_ns,
            self.identity.frame_id,
            dtype=wanted.dtype,
            compression=wanted.compression,
        )
        info = TileInfo(
            map=self.identity.map,
            instance=self.identity.instance,
            epoch=self.epoch,
            z=frozen.level,
            x=x,
            y=y,
            sequence=sequence,
            map_sequence=0,
            answer_tiles=0,
            oldest_ns=oldest_ns,
            newest_ns=newest_ns,
            known_cells=known_cells,
            digest=frozen.digest(x, y),
            configuration_digest=self.identity.configuration_digest,
            compression=wanted.compression,
        )
        return drawn_tile(payload, info, known)


def region_reply(drawing: Drawing, cells: CellBox, compression: Compression) -> TileReply:
    """One Grid over the cells (i0, j0, i1, j1), half-open, whose tiles ``drawing`` must hold.

    A mosaic of tiles as they are drawn, without compression, for tile queries. Its stamps and its sequence are those of
    the tiles that it touches.
    """
    frozen, wanted, identity = drawing.frozen, drawing.wanted, drawing.identity
    i0, j0, i1, j1 = cells
    x0, y0, x1, y1 = tile_box(cells)
    inside = (frozen.tiles >= (x0, y0)).all(axis=1) & (frozen.tiles <= (x1, y1)).all(axis=1)
    tiles, sequences = frozen.tiles[inside].tolist(), frozen.sequences[inside].tolist()
    packed = np.empty((j1 - j0, i1 - i0, len(wanted.layers)), np.dtype(f"<{wanted.dtype}"))
    if len(tiles) < (x1 - x0 + 1) * (y1 - y0 + 1):
        blank = [0.0 if name in ZERO_WHERE_UNKNOWN else np.nan for name in wanted.layers]
        packed.reshape(j1 - j0, -1)[:] = np.tile(np.array(blank, packed.dtype), i1 - i0)  # ten times packed[:] = blank
    known_cells, stamps = 0, []
    along_x = {x: overlap(x, i0, i1) for x in range(x0, x1 + 1)}
    along_y = {y: overlap(y, j0, j1) for y in range(y0, y1 + 1)}
    for (x, y), sequence in zip(tiles, sequences, strict=True):
        drawn = drawing.tile(x, y, sequence)
        (across, columns), (up, rows) = along_x[x], along_y[y]
        values = packed_data(drawn.payload, (TILE_CELLS, TILE_CELLS, len(wanted.layers)), wanted.dtype)
        packed[up, across] = values[rows, columns]
        known_cells += drawn.known_among(rows, columns)
        stamps.append((drawn.info.oldest_ns, drawn.info.newest_ns))
    info = TileInfo(
        map=identity.map,
        instance=identity.instance,
        epoch=drawing.epoch,
        z=frozen.level,
        x=None,
        y=None,
        sequence=max(sequences, default=0),
        map_sequence=frozen.sequence,
        answer_tiles=1,
        oldest_ns=min((oldest for oldest, _ in stamps), default=0),
        newest_ns=max((newest for _, newest in stamps), default=0),
        known_cells=known_cells,
        digest=None,
        configuration_digest=identity.configuration_digest,
        compression=compression,
    )
    payload = encode_packed(
        wanted.layers,
        packed,
        (i0 * frozen.cell_size, j0 * frozen.cell_size),
        frozen.cell_size,
        info.newest_ns,
        identity.frame_id,
        compression=compression,
    )
    return TileReply(payload, model_bytes(info))


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
