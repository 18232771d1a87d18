"""The tiles of one level of the map as they were at one moment, while the map itself changes."""

import warnings
from collections.abc import Callable, Hashable
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
import xxhash

from roughmap.arrays import I4, I8, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.reading import levels
from roughmap.reading.halo import Neighbour, fine_neighbour
from roughmap.reading.merge_cache import MergeCache, Sized
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.index import TILE_LIMIT, TileBox, packed
from roughmap.tiles.state import TileState
from roughmap.tiles.table import TileTable

UNKNOWN_TILE = np.zeros((TILE_CELLS, TILE_CELLS), dtype=CELL_DTYPE)
UNKNOWN_TILE.flags.writeable = False

Made = TypeVar("Made", bound=Sized)


class _SortedTiles:
    """The tiles of one level, ascending by signed (x, y), found by bisection."""

    def __init__(self, x: I4, y: I4, sequence: I8) -> None:
        self.x = x
        self.y = y
        self.sequence = sequence
        self._packed = packed(x, y)

    def find(self, x: int, y: int) -> int:
        """Return the position of tile (x, y), or -1."""
        if not (-TILE_LIMIT <= x < TILE_LIMIT and -TILE_LIMIT <= y < TILE_LIMIT):
            return -1
        wanted = (x << 32) + y
        place = int(self._packed.searchsorted(wanted))
        return place if place < len(self._packed) and self._packed[place] == wanted else -1


class FrozenTiles:
    """The tiles of one level within a box, and the ring of tiles around it, as they were when the map was frozen.

    `RoughMap.freeze` creates one, as a `FrozenMap`, under the caller's lock; the caller closes it, or leaves the
    ``with`` block, under the same lock. All other methods need no lock, and several threads may call them at once while
    the map changes: the map copies a tile that is frozen before it changes it. A tile that is not in memory is read
    from the shelf, whose errors then come from here. Arrays of records are read-only and valid until ``close``.
    ValueError for a level that the map does not have.

    Attributes:
        surface: "ground" or "all".
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
        surface: str,
        level: int,
        box: TileBox | None,
        after: int,
        cell_size: float,
        sequence: int,
        newest_updated: int,
    ) -> None:
        if not 0 <= level < len(table.levels):
            raise ValueError(f"level is {level}; expected 0 to {len(table.levels) - 1}")
        self.surface = surface
        self.level = level
        self.box = box
        self.cell_size = cell_size * (1 << level)
        self.sequence = sequence
        self.newest_updated = newest_updated
        self._table = table
        self._cache = cache
        # What is merged of the changed tiles alone must not pass for the whole.
        self._state = cache.generation, max(after, -1) if level else -1
        self._slots: I4 | None = None
        while cache.abandoned:
            left, slots = cache.abandoned.popleft()
            left.unpin(slots)

        base = table.levels[0]
        # Above level 0, whether ground is confirmed is read from level 0. The ring's cells, too, need a ring for that.
        entries = table.select(_ring(box, level, 0, more=int(surface == "ground" and level > 0)))
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
        self._neighbours: dict[tuple[int, int], Neighbour] = {}
        table.pin(slots)
        self._slots = slots

    def close(self) -> None:
        """Release the tiles, under the lock of the map's methods. A second call does nothing."""
        if self._slots is not None:
            self._table.unpin(self._slots)
            self._slots = None
            self._neighbours.clear()

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
        found = self.cells(self.level, x, y)
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

    def digest(self, x: int, y: int) -> str:
        """Return the XXH3-128 of the tile in hex; see `tile_digest`. Above level 0, of its merged cells alone."""
        if self.level == 0 and (state := self.state(x, y)) is not None:
            return tile_digest(state).hex()
        return xxhash.xxh3_128_hexdigest(self.records(x, y).reshape(-1).view(np.uint8).data)

    def side(self, z: int) -> float:
        """Return the side of the cells of a level up to that of the map, metres."""
        return self.cell_size / (1 << (self.level - z))

    def state(self, x: int, y: int) -> TileState | None:
        """Return the arrays of a tile of level 0, read-only; None if absent."""
        place = self._index[0].find(x, y)
        if place < 0:
            return None
        if self._slots is None:
            raise ValueError("this frozen map is closed")
        slot, table = int(self._slots[place]), self._table
        if slot >= 0:
            return table.state(slot)
        return self.cached("state", 0, x, y, (), lambda: table.state(slot))

    def neighbour(self, x: int, y: int) -> Neighbour | None:
        """Return a tile of level 0 as its neighbours see it; None if absent. Each tile is seen nine times."""
        found = self._neighbours.get((x, y))
        if found is None and (state := self.state(x, y)) is not None:
            found = fine_neighbour(state)
            if self._slots is not None and self._slots[self._index[0].find(x, y)] >= 0:  # a view of memory
                self._neighbours[x, y] = found
        return found

    def cells(self, z: int, x: int, y: int) -> Records | None:
        """Return the (64, 64) records of a tile of level z, merged from level 0 if z > 0; None if absent."""
        if z == 0:
            state = self.state(x, y)
            return None if state is None else state.cells.reshape(TILE_CELLS, TILE_CELLS)
        below = children(x, y)
        return self.cached("cells", z, x, y, (), lambda: levels.merge([self.cells(z - 1, *child) for child in below]))

    def trust(self, z: int, x: int, y: int) -> Records | None:
        """Return the (64, 64) trust of a tile of level z, merged from level 0 if z > 0; None if absent."""
        if z == 0:
            state = self.state(x, y)
            return None if state is None else state.trust.reshape(TILE_CELLS, TILE_CELLS)

        def make() -> Records:
            below = children(x, y)
            cells, trust = ([read(z - 1, *child) for child in below] for read in (self.cells, self.trust))
            return levels.merge_trust(cells, trust)

        return self.cached("trust", z, x, y, (), make)

    def cached(self, kind: str, z: int, x: int, y: int, parameters: Hashable, make: Callable[[], Made]) -> Made | None:
        """Return what ``make`` makes of the state of a tile of level z, from the cache if it is there; None if absent.

        It depends on nothing but the tile, its ring, ``kind`` and ``parameters``.
        """
        place = self._index[z].find(x, y)
        if place < 0:
            return None
        # the cells of a tile have not changed since its sequence
        key = kind, z, x, y, int(self._index[z].sequence[place]), self._state, parameters
        return self._cache.get(key, make, lower=z < self.level)


def children(x: int, y: int) -> tuple[tuple[int, int], ...]:
    """Return the four tiles of the level below, in the order of the merge."""
    return (2 * x, 2 * y), (2 * x + 1, 2 * y), (2 * x, 2 * y + 1), (2 * x + 1, 2 * y + 1)


def nine(x: int, y: int) -> list[tuple[int, int]]:
    """Return a tile among its neighbours: from south to north, in each row from west to east."""
    return [(x + dx, y + dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]


def _ring(box: TileBox | None, level: int, z: int, more: int = 0) -> TileBox | None:
    """Return the tiles of level z <= ``level`` under the box and the ring of tiles around it, clipped to the map.

    ``more``: tiles of level z around that.
    """
    if box is None:
        return None
    x0, y0, x1, y1 = box
    shift = level - z
    limit = TILE_LIMIT >> z
    return (
        max(((x0 - 1) << shift) - more, -limit),
        max(((y0 - 1) << shift) - more, -limit),
        min(((x1 + 2) << shift) - 1 + more, limit - 1),
        min(((y1 + 2) << shift) - 1 + more, limit - 1),
    )
