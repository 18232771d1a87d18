"""What readers see of the map: whole scans, at one sequence and epoch at a time."""

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from roughmap import RoughMap
from roughmap.reading.frozen import FrozenMap
from roughmap.tiles.index import TileBox, TileVersions


@dataclass(frozen=True, slots=True)
class Standing:
    """The map right before the current change: enough for answers whose tiles are already drawn."""

    epoch: int
    sequence: int
    newest_updated: int
    levels: Sequence[TileVersions]


class View:
    """The map behind its one lock.

    The sequencer prepares a change and brings its tiles into memory without the lock, then changes the map inside
    `change`. A reader pins what it needs under the lock and reads it after releasing it, while the map changes. So no
    thread uses a disk under the lock. A reader waits at most for the rest of one scan's update of cells, or for other
    readers. Pinning a few tiles takes some 50 us; for the whole map the time grows with the map. A waiting reader gets
    the lock before the next change begins, however fast changes follow each other.
    """

    def __init__(self, rough_map: RoughMap, epoch: int) -> None:
        self.map = rough_map
        self.epoch = epoch
        self.standing: Standing | None = None
        """During a change, the map before it; None if nothing was read since the previous change."""
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._left: deque[FrozenMap] = deque()
        self._was_read = False
        self._changed = threading.Condition(threading.Lock())
        self._closed = False

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Hold the lock.

        The sequencer could take a plain lock again and again, since it is awake when it releases it. Here it must
        first get the turn, which a waiting reader holds.
        """
        with self._turn:
            self._lock.acquire()
        try:
            self._close_left()
            yield
        finally:
            self._lock.release()
            self._close_left_if_free()

    def _close_left(self) -> None:
        """Close what readers left here; call it with the lock held."""
        while self._left:
            self._left.popleft().close()

    def _close_left_if_free(self) -> None:
        """Close what readers left here, unless the lock is held.

        Called after each release, and after each reader that leaves something. One of the two calls finds the lock
        free, so nothing stays pinned.
        """
        while self._left and self._lock.acquire(blocking=False):
            try:
                self._close_left()
            finally:
                self._lock.release()

    @contextmanager
    def change(self) -> Iterator[RoughMap]:
        """Hold the map for writing. Readers see all changes at once when this ends."""
        with self._held():
            if self._was_read:
                self._was_read = False
                m = self.map
                self.standing = Standing(self.epoch, m.sequence, m.newest_updated, m.tile_versions())
            try:
                yield self.map
            finally:
                self.standing = None
        with self._changed:
            self._changed.notify_all()

    @contextmanager
    def reading(self) -> Iterator[RoughMap]:
        """Hold the map to read its numbers and to list or pin tiles; scans and other readers wait meanwhile.

        Listing all tiles takes longer in a larger map. Read, write and send tiles only after this.
        """
        with self._held():
            yield self.map

    @contextmanager
    def freeze(self, level: int = 0, box: TileBox | None = None) -> Iterator[tuple[FrozenMap, int]]:
        """Freeze a part of the map; yield it and its epoch. See `RoughMap.freeze` for ``level`` and ``box``."""
        with self.reading() as rough_map:
            frozen, epoch = rough_map.freeze(level, box), self.epoch
        try:
            yield frozen, epoch
        finally:
            self.let_go(frozen)

    def will_read(self) -> None:
        """Ask for `standing` at the next change."""
        self._was_read = True

    def let_go(self, frozen: FrozenMap) -> None:
        """Close a frozen part of the map: now, or when the lock is released if it is held. Never wait."""
        self._left.append(frozen)
        self._close_left_if_free()

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
