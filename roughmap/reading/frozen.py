"""The frozen map: the tiles of one level as they were at one moment, while the map itself changes."""

import warnings
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import xxhash

from roughmap.arrays import F8, I4, I8, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.reading import layers, levels, terrain
from roughmap.reading.cell_values import cell_layers, packed_cell_layers
from roughmap.reading.merge_cache import MergeCache
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.index import TILE_LIMIT, TileBox
from roughmap.tiles.state import TileState
from roughmap.tiles.table import TileTable

UNKNOWN_TILE = np.zeros((TILE_CELLS, TILE_CELLS), dtype=CELL_DTYPE)
UNKNOWN_TILE.flags.writeable = False


class _SortedTiles:
    """The tiles of one level, ascending by signed (x, y), found by bisection."""

    def __init__(self, x: I4, y: I4, sequence: I8) -> None:
        self.x = x
        self.y = y
        self.sequence = sequence
        self._packed = self._pack(x, y)

    @staticmethod
    def _pack(x: I4, y: I4) -> I8:
        return (x.astype(np.int64) << 32) + y

    def find(self, x: int, y: int) -> int:
        """Return the position of tile (x, y), or -1."""
        if not (-TILE_LIMIT <= x < TILE_LIMIT and -TILE_LIMIT <= y < TILE_LIMIT):
            return -1
        packed = (x << 32) + y
        place = int(self._packed.searchsorted(packed))
        return place if place < len(self._packed) and self._packed[place] == packed else -1


class FrozenMap:
    """The tiles of one level within a box, and the ring of tiles around it, as they were when the map was frozen.

    `RoughMap.freeze` creates it under the caller's lock; the caller closes it, or leaves the ``with`` block, under the
    same lock. All other methods need no lock, and several threads may call them at once while the map changes: the map
    copies a tile that is frozen before it changes it. A tile that is not in memory is read from the shelf, whose errors
    then come from here. Arrays of records are read-only and valid until ``close``. ValueError for a level that the map
    does not have.

    Attributes:
        level: the level; 0 for the map's own cells.
        box: the requested tiles (x0, y0, x1, y1) of the level, inclusive; None for all.
        cell_size: side of the level's cells, metres.
        sequence: sequence of the map at that moment.
        newest_updated: newest `updated` of the map, in seconds.
        tiles: (T, 2) int32, the tiles of the level in the box that have a known cell, ascending by (x, y).
        sequences: (T,) int64, the sequence at which the cells of each tile, or the ring around them, last changed.
    """

    def __init__(
        self,
        table: TileTable,
        cache: MergeCache,
        *,
        level: int,
        box: TileBox | None,
        after: int,
        cell_size: float,
        sequence: int,
        newest_updated: int,
    ) -> None:
        if not 0 <= level < len(table.levels):
            raise ValueError(f"level is {level}; expected 0 to {len(table.levels) - 1}")
        self.level = level
        self.box = box
        self.cell_size = cell_size * (1 << level)
        self.sequence = sequence
        self.newest_updated = newest_updated
        self._table = table
        self._cache = cache
        self._generation = cache.generation
        self._slots: I4 | None = None
        while cache.abandoned:
            left, slots = cache.abandoned.popleft()
            left.unpin(slots)

        base = table.levels[0]
        entries = table.select(_ring(box, level, 0))
        if after >= 0:
            entries = entries[base.sequence[entries] > after]
        slots = table.slot[entries]
        if level == 0 and box is not None:  # likely to be read again; ranks one step behind written tiles
            table.used[entries] = np.maximum(table.used[entries], sequence - 1)
        self._oldest_ns = table.oldest_ns[entries]
        self._newest_ns = table.newest_ns[entries]
        self._index = [_SortedTiles(base.tx[entries], base.ty[entries], base.sequence[entries])]
        for z in range(1, level + 1):
            self._index.append(_SortedTiles(*table.levels[z].select(_ring(box, level, z))))
        asked = self._index[level]
        inside = np.ones(len(asked.x), dtype=bool)
        if box is not None:
            x0, y0, x1, y1 = box
            inside = (asked.x >= x0) & (asked.x <= x1) & (asked.y >= y0) & (asked.y <= y1)
        self.tiles: I4 = np.column_stack((asked.x[inside], asked.y[inside]))
        self.sequences: I8 = asked.sequence[inside]
        table.pin(slots)
        self._slots = slots

    def close(self) -> None:
        """Release the tiles, under the lock of the map's methods. A second call does nothing."""
        if self._slots is not None:
            self._table.unpin(self._slots)
            self._slots = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        slots = getattr(self, "_slots", None)
        if slots is not None:
            # The lock cannot be taken here. The next `freeze` holds it, and releases the tiles.
            self._cache.abandoned.append((self._table, slots))
            warnings.warn("a frozen map was never closed", ResourceWarning, source=self, stacklevel=2)

    def covers(self, box: TileBox) -> bool:
        """Whether the box contains these tiles of the level, (x0, y0, x1, y1) inclusive."""
        if self.box is None:
            return True
        x0, y0, x1, y1 = self.box
        return x0 <= box[0] and y0 <= box[1] and box[2] <= x1 and box[3] <= y1

    def records(self, x: int, y: int) -> Records:
        """Return the (64, 64) records of a tile of the level, row = j along y, column = i along x; zeros if absent."""
        found = self._records(self.level, x, y)
        return UNKNOWN_TILE if found is None else found

    def stamps(self, x: int, y: int) -> tuple[int, int]:
        """Return the oldest and the newest stamp, in ns, of the level-0 tiles under the tile. KeyError if absent."""
        base, z = self._index[0], self.level
        if z == 0 and (place := base.find(x, y)) >= 0:
            return int(self._oldest_ns[place]), int(self._newest_ns[place])
        low, high = np.searchsorted(base.x, (x << z, (x + 1) << z))
        below = np.flatnonzero(base.y[low:high] >> z == y) + low
        if below.size == 0:
            raise KeyError(f"no tile ({x}, {y}) at level {z}")
        return int(self._oldest_ns[below].min()), int(self._newest_ns[below].max())

    def known_cells(self, x: int, y: int) -> int:
        """Return the number of known cells in the tile."""
        return int(np.count_nonzero(self.records(x, y)["count"]))

    def state(self, x: int, y: int) -> TileState | None:
        """Return the arrays of a tile of level 0, read-only; None if absent."""
        place = self._index[0].find(x, y)
        if place < 0:
            return None
        if self._slots is None:
            raise ValueError("this frozen map is closed")
        return self._table.state(int(self._slots[place]))

    def digest(self, x: int, y: int) -> str:
        """Return the XXH3-128 of the tile in hex; see `tile_digest`. Above level 0, of its merged cells alone."""
        state = self.state(x, y) if self.level == 0 else None
        if state is not None:
            return tile_digest(state).hex()
        return xxhash.xxh3_128_hexdigest(self.records(x, y).reshape(-1).view(np.uint8).data)

    def tile_layers(
        self,
        x: int,
        y: int,
        names: Iterable[str],
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> dict[str, F8]:
        """Return layers of a tile of the level, in the order of ``names``, each (64, 64) float64; see
        ``layers.LAYERS``.

        ``height_tolerance``: full width of the interval of ``confidence_level``, metres. ``limits``: those of
        ``traversability``; None for ``layers.DEFAULT_LIMITS``. ValueError for unknown names and invalid values.
        """
        names = layers.check_names(names)
        tolerance = layers.check_tolerance(height_tolerance)
        bounds = layers.check_limits(limits)
        own = [name for name in names if name in layers.CELL_LAYERS]
        found = cell_layers(self.records(x, y), own, tolerance, self.newest_updated)
        if len(own) < len(names):
            found |= self._neighbour_layers(x, y, names, tolerance, bounds)
        return {name: found[name] for name in names}

    def packed_layers(
        self,
        x: int,
        y: int,
        names: Iterable[str],
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> npt.NDArray[np.float32]:
        """Return what `tile_layers` does as one array, (64, 64, L) float32: all layers of a cell together.

        Values that float32 can't hold are infinite.
        """
        names = layers.check_names(names)
        if all(name in layers.CELL_LAYERS for name in names):
            tolerance = layers.check_tolerance(height_tolerance)
            layers.check_limits(limits)
            return packed_cell_layers(self.records(x, y), names, tolerance, self.newest_updated)
        packed = np.empty((TILE_CELLS, TILE_CELLS, len(names)), np.float32)
        with np.errstate(over="ignore"):
            for number, plane in enumerate(self.tile_layers(x, y, names, height_tolerance, limits).values()):
                packed[:, :, number] = plane
        return packed

    def _neighbour_layers(
        self, x: int, y: int, names: tuple[str, ...], tolerance: float, limits: layers.GroundLimits
    ) -> dict[str, F8]:
        found = {}
        wanted = "traversability" in names
        if wanted and self.level > 0:
            least = self._traversability(self.level, x, y, tolerance, limits)
            found["traversability"] = np.full((TILE_CELLS, TILE_CELLS), np.nan) if least is None else least.copy()
            wanted = False
        ground = self._ground(self.level, x, y, tolerance, limits if wanted else None)
        return {name: getattr(ground, name) for name in layers.NEIGHBOUR_LAYERS} | found

    def _ground(self, z: int, x: int, y: int, tolerance: float, limits: layers.GroundLimits | None) -> terrain.Terrain:
        """Return the terrain of a tile, with traversability only if ``limits`` are given."""
        mean = self._means(z, x, y)
        side = self.cell_size / (1 << (self.level - z))
        if limits is None:
            return terrain.derive(mean, side)
        records = self._records(z, x, y)
        names = ("std_dev", "range", "confidence_level")
        spread = cell_layers(UNKNOWN_TILE if records is None else records, names, tolerance, 0)
        return terrain.derive(mean, side, limits, *spread.values())

    def _traversability(self, z: int, x: int, y: int, tolerance: float, limits: layers.GroundLimits) -> F8 | None:
        """Return the traversability of a tile of level z: above level 0, the least of its children; None if absent."""
        place = self._index[z].find(x, y)
        if place < 0:
            return None
        if z == 0:
            return self._ground(0, x, y, tolerance, limits).traversability

        def make() -> F8:
            below = [self._traversability(z - 1, cx, cy, tolerance, limits) for cx, cy in _children(x, y)]
            return terrain.coarsen_least(below)

        return self._cache.get((*self._cache_key(z, x, y, place), tolerance, limits), make, lower=z < self.level)

    def _means(self, z: int, x: int, y: int) -> F8:
        """Return the (66, 66) mean heights of a tile with a halo of one cell, NaN where unknown."""
        size = TILE_CELLS + 2
        out = np.full((size, size), np.nan)
        inner, low, high = slice(1, size - 1), slice(0, 1), slice(size - 1, size)
        whole, first, last = slice(None), slice(0, 1), slice(TILE_CELLS - 1, TILE_CELLS)
        places = ((-1, low, last), (0, inner, whole), (1, high, first))
        for dy, rows, their_rows in places:
            for dx, columns, their_columns in places:
                records = self._records(z, x + dx, y + dy)
                if records is not None:
                    part = records[their_rows, their_columns]
                    np.copyto(out[rows, columns], part["mean"], where=part["count"] != 0)
        return out

    def _records(self, z: int, x: int, y: int) -> Records | None:
        """Return the records of a tile of level z, merged from level 0 if z > 0; None if absent."""
        place = self._index[z].find(x, y)
        if place < 0:
            return None
        if z == 0:
            if self._slots is None:
                raise ValueError("this frozen map is closed")
            slot, table = int(self._slots[place]), self._table
            if slot >= 0:
                return table.records(slot).reshape(TILE_CELLS, TILE_CELLS)
            return self._cache.get(
                self._cache_key(z, x, y, place),
                lambda: table.records(slot).reshape(TILE_CELLS, TILE_CELLS),
                lower=z < self.level,
            )

        def make() -> Records:
            return levels.merge([self._records(z - 1, cx, cy) for cx, cy in _children(x, y)])

        return self._cache.get(self._cache_key(z, x, y, place), make, lower=z < self.level)

    def _cache_key(self, z: int, x: int, y: int, place: int) -> tuple[int, ...]:
        """Return the cache key of a tile's state; its cells have not changed since its sequence."""
        return z, x, y, int(self._index[z].sequence[place]), self._generation


def _children(x: int, y: int) -> tuple[tuple[int, int], ...]:
    """Return the four tiles of the level below, in the order of the merge."""
    return (2 * x, 2 * y), (2 * x + 1, 2 * y), (2 * x, 2 * y + 1), (2 * x + 1, 2 * y + 1)


def _ring(box: TileBox | None, level: int, z: int) -> TileBox | None:
    """Return the tiles of level z <= ``level`` under the box and the ring of tiles around it, clipped to the map."""
    if box is None:
        return None
    x0, y0, x1, y1 = box
    shift = level - z
    limit = TILE_LIMIT >> z
    return (
        max((x0 - 1) << shift, -limit),
        max((y0 - 1) << shift, -limit),
        min(((x1 + 2) << shift) - 1, limit - 1),
        min(((y1 + 2) << shift) - 1, limit - 1),
    )
