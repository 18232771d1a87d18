"""Memory that is used again from one scan to the next, and the threads that share the work."""

import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8, I8, U8
from roughmap.index import rehash
from roughmap.place import BLOCK, LEVERS
from roughmap.update import QUEUE

_KEPT_POINTS = 1 << 18
"""Planes for more points than this (some 25 MB) are given back after the call that needed them."""

_POINTS_A_THREAD = 2048
"""Fewer are not worth a thread."""


def blocks_of(number: int) -> int:
    """Blocks into which so many points fall."""
    return -(-number // BLOCK)


class Planes:
    """One array a quantity, for the points of a scan; ``cells`` and ``body`` block by block.

    A plane of a block is contiguous, however many points there are: without that its loops aren't vectorised.
    """

    def __init__(self, number: int) -> None:
        self.x = np.empty(number)
        self.y = np.empty(number)
        self.z = np.empty(number)
        self.reason = np.zeros(number, np.uint8)
        self.cells = np.empty((blocks_of(number), 4, BLOCK), np.int32)
        self.body = np.empty((blocks_of(number), 5, BLOCK))
        self.home = np.empty(number, np.int32)

    def first(self, number: int) -> "Planes":
        """Views for ``number`` points, each without gaps: kernels are compiled for that layout alone."""
        part = Planes.__new__(Planes)
        for name, array in vars(self).items():
            setattr(part, name, array[: number if array.ndim == 1 else blocks_of(number)])
        return part


class Queue(NamedTuple):
    """Updates of cells that wait: addresses of cells, weights, points."""

    cell: U8
    weight: F8
    point: I8


class ThreadScratch:
    """What one thread needs for itself: a block's covariances, a footprint's shares."""

    def __init__(self, side: int) -> None:
        self.levers = np.empty((LEVERS, BLOCK))
        self.S = np.empty((6, BLOCK))
        self.bracket = np.empty(BLOCK, np.int64)
        self.lines = np.zeros((5, side + 1))
        self.shares = np.empty(side * side)
        room = QUEUE + side * side
        self.queue = Queue(np.empty(room, np.uint64), np.empty(room), np.empty(room, np.int64))


class TouchedTiles:
    """The tiles of one scan, by key: a small hash that doubles when it is half full."""

    def __init__(self) -> None:
        self.table = np.full(1024, -1, np.int32)
        self.keys = np.zeros(512, np.uint64)
        self.work = np.zeros(512, np.int64)

    def clear(self) -> None:
        """Forget all tiles."""
        self.table[:] = -1

    def double(self, used: int) -> None:
        """Twice the room, the first ``used`` tiles kept."""
        self.keys = np.append(self.keys, np.zeros_like(self.keys))
        self.work = np.append(self.work, np.zeros_like(self.work))
        self.table = np.empty(2 * len(self.table), np.int32)
        rehash(self.table, self.keys, used)


class Workspace:
    """Planes, scratch and threads of one map. ``side``: most cells of a footprint along an axis."""

    def __init__(self, threads: int, side: int) -> None:
        self.threads = threads
        self.side = side
        self.tiles = TouchedTiles()
        self._planes = Planes(0)
        self._scratch = [ThreadScratch(side)]
        self._pool: ThreadPoolExecutor | None = None

    @property
    def scratch(self) -> list[ThreadScratch]:
        """One a thread, as far as threads were needed."""
        return self._scratch

    def planes(self, number: int) -> Planes:
        """Planes for ``number`` points; what they hold is left from before, but for ``reason``, which is 0."""
        if number > len(self._planes.x):
            planes = Planes(max(number, 4096))
            if number > _KEPT_POINTS:
                return planes.first(number)
            self._planes = planes
        part = self._planes.first(number)
        part.reason[:] = 0
        return part

    def parts(self, number: int) -> int:
        """Into how many parts the work on so many points is split."""
        return max(1, min(self.threads, number // _POINTS_A_THREAD))

    def run(self, parts: int, task: Callable[[int, ThreadScratch], None]) -> None:
        """Call ``task(part, scratch)`` for each part, each in a thread; the first in this one."""
        while len(self._scratch) < parts:
            self._scratch.append(ThreadScratch(self.side))
        if parts > 1 and self._pool is None:
            self._pool = ThreadPoolExecutor(self.threads - 1, "roughmap")
            weakref.finalize(self, self._pool.shutdown, wait=False)
        others = [self._pool.submit(task, n, self._scratch[n]) for n in range(1, parts)] if self._pool else []
        try:
            task(0, self._scratch[0])
        finally:
            for other in others:
                other.result()

    def close(self) -> None:
        """End the threads; they begin anew when they are needed."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
