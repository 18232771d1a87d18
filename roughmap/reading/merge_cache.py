"""Cache of tiles that were merged or read from the shelf, shared by all frozen maps."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt

from roughmap.tiles.table import TileTable

CACHE_BYTES = 64 << 20
"""256 tiles. Computing a tile of level 1 again costs about 50 us; one of level 7 reads up to 4 GB of cells."""

Key = tuple[object, ...]


class Sized(Protocol):
    """An array, or several that belong together."""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""


Made = TypeVar("Made", bound=Sized)


class MergeCache:
    """Arrays of the levels above 0, and level-0 tiles read from the shelf, shared by all readers in all threads.

    Keys contain the state of the map that an array belongs to, so entries never become outdated. The least recently
    used entries are evicted first. Entries of levels below the one that is read go first while they take over half of
    the limit: a tile of level 3 is made of 84 lower ones, which would evict its neighbours, and each neighbour is
    needed nine times for slopes. ``limit`` is the limit on the bytes of all arrays.

    Attributes:
        generation: part of every key. Changes of cells that do not raise the map's sequence (a reset, a loaded tile)
            raise it, under the map's lock.
        abandoned: slots still pinned by frozen maps that were never closed. The next `freeze` releases them.
    """

    def __init__(self, limit: int = CACHE_BYTES) -> None:
        self.limit = limit
        self.generation = 0
        self.abandoned: deque[tuple[TileTable, npt.NDArray[np.int32]]] = deque()
        # Two parts: entries of the level that is read, and entries of lower levels.
        self._kept: tuple[OrderedDict[Key, Sized], ...] = OrderedDict(), OrderedDict()
        self._bytes = [0, 0]
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], Made], *, lower: bool = False) -> Made:
        """Return what is cached under ``key``, else cache and return the result of ``make``, which must not change.

        ``lower``: it belongs to a level below the one that is read. ``make`` runs without the lock: two threads
        may compute the same array at once, and one of the two is kept.
        """
        with self._lock:
            for kept in self._kept:
                if key in kept:
                    kept.move_to_end(key)
                    return cast("Made", kept[key])
        made = make()
        with self._lock:
            if not any(key in kept for kept in self._kept) and made.nbytes <= self.limit:
                self._kept[lower][key] = made
                self._bytes[lower] += made.nbytes
            while self.nbytes > self.limit:
                most = self._bytes[True] > self.limit // 2
                self._bytes[most] -= self._kept[most].popitem(last=False)[1].nbytes
        return made

    @property
    def nbytes(self) -> int:
        """Bytes of the cached arrays."""
        return sum(self._bytes)
