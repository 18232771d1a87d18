"""What readers see of the map: whole scans only, one sequence and one epoch at a time."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from roughmap import RoughMap
from roughmap.frozen import Frozen, TileBox


class View:
    """The map behind its one lock.

    The sequencer changes the map inside `change`; a reader pins what it needs inside the lock (microseconds, or at most
    the rest of one scan's integration) and reads it afterwards without any lock, while the map goes on.
    """

    def __init__(self, rough_map: RoughMap, epoch: int) -> None:
        self.map = rough_map
        self.epoch = epoch
        self._lock = threading.Lock()
        self._changed = threading.Condition(threading.Lock())
        self._closed = False

    @contextmanager
    def change(self) -> Iterator[RoughMap]:
        """Hold the map for writing; what was done is seen by readers, all at once, when this ends."""
        with self._lock:
            yield self.map
        with self._changed:
            self._changed.notify_all()

    @contextmanager
    def reading(self) -> Iterator[RoughMap]:
        """Hold the map for a short look at its plain numbers (sequence, extent, counts); never for I/O."""
        with self._lock:
            yield self.map

    @contextmanager
    def freeze(self, level: int = 0, box: TileBox | None = None) -> Iterator[tuple[Frozen, int]]:
        """A frozen part of the map and the epoch that it is of; see `RoughMap.freeze` for ``level`` and ``box``."""
        with self._lock:
            frozen, epoch = self.map.freeze(level, box), self.epoch
        try:
            yield frozen, epoch
        finally:
            with self._lock:
                frozen.close()

    def wait_change(self, after: tuple[int, int], timeout: float) -> bool:
        """Wait at most ``timeout`` seconds until (epoch, sequence) is no longer ``after``; False if it still is."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._closed or (self.epoch, self.map.sequence) != after, timeout=timeout
            )

    def wake(self) -> None:
        """End all waits, at shutdown."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
