"""Drawn tiles kept for the next reader: each state of a tile is read and drawn once."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

from roughmap_service.answers.drawn_tile import DrawnTile

ENTRY_BYTES = 4096
"""Cost of an entry beside its cells: key, info and its JSON, known cells, objects."""


class TileCache:
    """At most ``limit`` bytes of drawn tiles, shared by all readers; the least recently used tile goes first.

    A key names the state of the tile and its form, so no entry is ever outdated.
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
        """Return the tile under ``key``; if there is none, call ``draw`` and keep its result.

        ``draw`` runs outside the lock: two readers may draw the same tile at once, and one result is kept.
        """
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
    return drawn.nbytes + ENTRY_BYTES
