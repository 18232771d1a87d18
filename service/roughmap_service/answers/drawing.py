"""Tiles drawn from one state of the map: each a foxglove.Grid and the `TileInfo` that goes with it."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from roughmap.reading.cell_values import known_bits
from roughmap.reading.frozen import FrozenMap
from roughmap_schemas.grid import Compression
from roughmap_schemas.messages import TileInfo
from roughmap_service.answers.drawn_tile import DrawnTile, Values
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.tile_cache import TileCache


@dataclass(frozen=True, slots=True)
class TileForm:
    """Which layers of each cell to draw, with which parameters, and how to encode them."""

    layers: tuple[str, ...]
    tolerance: float
    limits: Mapping[str, float]
    dtype: Literal["f4", "f8"] = "f4"
    compression: Compression = None

    @property
    def key(self) -> Hashable:
        """A key that is equal for equal forms."""
        return self.layers, self.tolerance, tuple(sorted(self.limits.items())), self.dtype, self.compression


class NotDrawnYet(Exception):
    """The cache does not hold the tile, and its cells are not at hand."""


@dataclass(frozen=True, slots=True, eq=False)
class TileList:
    """The tiles of one level without their cells: (T, 2) x and y, (T,) their sequences.

    It has the attributes of `FrozenMap` that name a state; a tile of it can be answered from the cache only.
    """

    level: int
    cell_size: float
    sequence: int
    newest_updated: int
    tiles: npt.NDArray[np.int32]
    sequences: npt.NDArray[np.int64]


class Drawing:
    """Draws the tiles of one level in one form; takes them from ``cache`` if they are there.

    From a `TileList` only cached tiles can be drawn; for any other, `tile` raises NotDrawnYet.
    """

    def __init__(
        self,
        frozen: FrozenMap | TileList,
        epoch: int,
        form: TileForm,
        served: ServedMap,
        cache: TileCache | None = None,
    ) -> None:
        self.frozen = frozen
        self.epoch = epoch
        self.form = form
        self.served = served
        self._cache = cache
        # A tile's sequence dates all of its layers except the age, which counts from the map's newest point.
        now = frozen.newest_updated if "age" in form.layers else None
        self._key = epoch, frozen.level, form.key, now

    def tile(self, x: int, y: int, sequence: int) -> DrawnTile:
        """Return tile (x, y), last changed at ``sequence``. A tile that is not in the map is drawn all unknown."""
        if self._cache is None:
            return self._draw(x, y, sequence)
        return self._cache.get((x, y, sequence, self._key), lambda: self._draw(x, y, sequence))

    def _draw(self, x: int, y: int, sequence: int) -> DrawnTile:
        frozen, form = self.frozen, self.form
        if isinstance(frozen, TileList):
            raise NotDrawnYet
        records = frozen.records(x, y)
        values = self._values(frozen, x, y)
        known_cells, known = known_bits(records)
        oldest_ns, newest_ns = frozen.stamps(x, y) if known_cells else (0, 0)
        info = TileInfo(
            map=self.served.map,
            instance=self.served.instance,
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
            configuration_digest=self.served.configuration_digest,
            compression=form.compression,
            surface=self.served.surface,
        )
        return DrawnTile(info, form.layers, values, known, frozen.cell_size, self.served.frame_id)

    def _values(self, frozen: FrozenMap, x: int, y: int) -> Values:
        form = self.form
        if form.dtype == "f4":
            return frozen.packed_layers(x, y, form.layers, form.tolerance, form.limits)
        return np.stack(list(frozen.tile_layers(x, y, form.layers, form.tolerance, form.limits).values()), axis=-1)
