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
    """The map right before the present change: enough for answers whose tiles are already drawn."""

    epoch: int
    sequence: int
    newest_updated: int
    levels: Sequence[TileVersions]


class View:
    """The map behind its one lock.

    The sequencer prepares a change without it, brings tiles into memory before, and changes the map inside `change`; a
    reader pins what it needs inside the lock and reads it afterwards without any, while the map goes on. So nobody is
    at a disk inside the lock. A reader waits at most for the rest of one scan's update of cells, or for other
    readers; a few tiles are pinned in some 50 us, the whole map in time that grows with it. Who waits for the lock gets
    it before the next change begins, however fast these follow each other.
    """

    def __init__(self, rough_map: RoughMap, epoch: int) -> None:
        self.map = rough_map
        self.epoch = epoch
        self.standing: Standing | None = None
        """While a change is going on, and if someone read since the last one, the map as it was before it."""
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._left: deque[FrozenMap] = deque()
        self._was_read = False
        self._changed = threading.Condition(threading.Lock())
        self._closed = False

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Hold the lock. A plain one would go again and again to the sequencer, which is awake when it lets go of it;
        here it must first get the turn, which a waiting reader holds."""
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

        Called after each release and after each reader that leaves something: one of the two finds the lock free, so
        nothing stays pinned.
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
        """A frozen part of the map and the epoch that it is of; see `RoughMap.freeze` for ``level`` and ``box``."""
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
        """Close a frozen part of the map now or, if the map is in use, when that use ends: no answer waits for it."""
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
