"""Tiles as they were encoded for one reader, kept for the next: each state of a tile is read and encoded once."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np

from roughmap.cell import TILE_CELLS

ENTRY_BYTES = 2048
"""What an entry costs beside its payload: the key, the objects, the digest, the bits."""


@dataclass(frozen=True, slots=True)
class DrawnTile:
    """One state of a tile as a Grid's bytes, and what its TileInfo says of that state."""

    payload: bytes
    known_cells: int
    oldest_ns: int
    newest_ns: int
    digest: str
    known: bytes
    """A bit a cell, row by row, as `numpy.packbits` makes them."""

    def known_among(self, rows: slice, columns: slice) -> int:
        """How many cells of a part are known."""
        bits = np.unpackbits(np.frombuffer(self.known, np.uint8)).reshape(TILE_CELLS, TILE_CELLS)
        return int(np.count_nonzero(bits[rows, columns]))


class TileCache:
    """At most ``limit`` bytes of drawn tiles, shared by all readers; what was not asked for the longest goes first.

    Keys tell the state of the tile and the form that was asked for, so that no entry is ever outdated.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tiles: OrderedDict[Hashable, DrawnTile] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Bytes held now."""
        return self._bytes

    def get(self, key: Hashable, draw: Callable[[], DrawnTile]) -> DrawnTile:
        """The tile kept under ``key``, else what ``draw`` gives, which is then kept. ``draw`` runs outside the lock:
        two readers may draw the same tile at once, and one of the two is kept."""
        with self._lock:
            found = self._tiles.get(key)
            if found is not None:
                self._tiles.move_to_end(key)
                return found
        drawn = draw()
        with self._lock:
            if key not in self._tiles:
                self._tiles[key] = drawn
                self._bytes += _cost(drawn)
            while self._bytes > self._limit:
                self._bytes -= _cost(self._tiles.popitem(last=False)[1])
        return drawn


def _cost(drawn: DrawnTile) -> int:
    return len(drawn.payload) + ENTRY_BYTES
