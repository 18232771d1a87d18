"""Tiles that were merged, or read from the shelf, kept from one reading to the next."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.tiles.table import TileTable

CACHE_BYTES = 64 << 20
"""256 tiles. A tile of level 1 costs some 50 us to make again, one of level 7 reads 4 GB of cells at most."""

Key = tuple[object, ...]
Array = npt.NDArray[Any]


class MergeCache:
    """What was derived from the map for the levels above 0, and tiles of level 0 that are not in memory, shared by all
    its readers, of any thread.

    The keys say of which state of the map an entry tells, so nothing is ever outdated; what was not asked for the
    longest goes first, of what lies beneath the level that is read while that takes over half: a tile of level 3 is
    made of 84 others, which would drive out its neighbours, and each is wanted nine times for slopes. ``limit`` bounds
    the bytes of all arrays together.

    Attributes:
        generation: part of every key; whoever changes cells without raising the map's sequence (a reset, a tile taken
            from a store) raises it, under the map's lock.
        abandoned: slots still pinned by readings that were never closed; the next reading gives them back. Until then
            their tiles stay in memory, as those of any open reading do.
    """

    def __init__(self, limit: int = CACHE_BYTES) -> None:
        self.limit = limit
        self.generation = 0
        self.abandoned: deque[tuple[TileTable, npt.NDArray[np.int32]]] = deque()
        self._kept: tuple[OrderedDict[Key, Array], ...] = OrderedDict(), OrderedDict()  # asked for, beneath
        self._bytes = [0, 0]
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], Array], *, beneath: bool = False) -> Array:
        """The array kept under ``key``, else what ``make`` returns, which is then kept and must not change any more.

        ``beneath``: it is wanted for one of a level above. ``make`` runs outside the lock: two threads may make the
        same array at once, and one of the two is kept.
        """
        with self._lock:
            for kept in self._kept:
                if key in kept:
                    kept.move_to_end(key)
                    return kept[key]
        made = make()
        with self._lock:
            if not any(key in kept for kept in self._kept) and made.nbytes <= self.limit:
                self._kept[beneath][key] = made
                self._bytes[beneath] += made.nbytes
            while self.nbytes > self.limit:
                most = self._bytes[True] > self.limit // 2
                self._bytes[most] -= self._kept[most].popitem(last=False)[1].nbytes
        return made

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays kept now."""
        return sum(self._bytes)
