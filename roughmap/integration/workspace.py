"""Memory that is used again from one scan to the next, and the threads that share the work."""

import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8, I4, I8, U1, U2, U8
from roughmap.cell import PointReason
from roughmap.integration.update import QUEUE, RUN
from roughmap.points.place import BLOCK, PLANES, STRIDE
from roughmap.tiles.index import rehash

_KEPT_POINTS = 1 << 18
"""Planes for more points than this (some 35 MB) are given back after the call that needed them."""

_KEPT_TILES = 1 << 16
"""A larger table of touched tiles is given back by the next call: it would be emptied anew for every scan."""

_POINTS_A_THREAD = 2048
"""Fewer are not worth a thread."""


def blocks_of(number: int) -> int:
    """Blocks into which so many points fall."""
    return -(-number // BLOCK)


class Planes(NamedTuple):
    """What is kept of a scan's points from their geometry to the update of the cells: an array a quantity.

    ``z``: height, map frame. ``q``: weight over share. ``weight`` (blocks, 4, BLOCK): weights in the cells (i, j),
    (i+1, j), (i, j+1), (i+1, j+1) of a plain point, 0 where it takes no part; ``corner``: cell (i, j) in its tile.

    A point is plain if its footprint is at most 2 x 2 cells of one tile; else it is odd. Plain points of one tile that
    follow each other make a run, and so does each odd point: from ``run_start`` to ``run_stop``, with ``run_home`` the
    row of that tile, or -1 - k for the odd point of row k. ``odd_box``: cells i0, j0, i1, j1, both ends in it;
    ``odd_body``: x, y, and four numbers of the error body; ``odd_home``: row of its tile, or -1 if there are several.
    The rows of a part's runs and odd points begin where its range of points begins.
    """

    z: F8
    reason: U1
    corner: U2
    q: F8
    weight: F8
    run_start: I4
    run_stop: I4
    run_home: I4
    odd_box: I4
    odd_body: F8
    odd_home: I4


def _planes(blocks: int) -> Planes:
    """Planes for so many blocks. Pages of the rows for odd points are not touched before there are such points."""
    number = blocks * BLOCK
    return Planes(
        np.empty(number),
        np.zeros(number, np.uint8),
        np.empty(number, np.uint16),
        np.empty(number),
        np.empty((blocks, 4, BLOCK)),
        np.empty(number, np.int32),
        np.empty(number, np.int32),
        np.empty(number, np.int32),
        np.empty((number, 4), np.int32),
        np.empty((number, 6)),
        np.empty(number, np.int32),
    )


class Block(NamedTuple):
    """What is known of a block's points only while it is worked on.

    ``planes`` (PLANES, STRIDE), ``bracket``: see `place`. ``cells`` (4, BLOCK): the footprint's i0, j0, i1,
    j1. ``body`` (4, BLOCK): half extents along x and y; of an ellipse also rho and beta. ``plain``: 1 for plain points.
    """

    planes: F8
    bracket: I8
    cells: I4
    body: F8
    plain: U1


class Queue(NamedTuple):
    """Updates of cells that wait: addresses of cells, weights, points."""

    cell: U8
    weight: F8
    point: I8


class Touched:
    """What a part of a scan touches: the tiles, by key, in a small hash that doubles when it is half full.

    ``work``: points in each tile. ``number``: tiles. ``runs``: the row after the last run. ``rejected``: points, by
    `PointReason`.
    """

    def __init__(self) -> None:
        self._begin()
        self.number = 0
        self.runs = 0
        self.rejected = np.zeros(len(PointReason), np.int64)

    def _begin(self) -> None:
        self.table = np.full(1024, -1, np.int32)
        self.keys = np.zeros(512, np.uint64)
        self.work = np.zeros(512, np.int64)

    @property
    def arrays(self) -> tuple[I4, U8, I8, I8]:
        """What the kernels take: table, keys, work, rejected."""
        return self.table, self.keys, self.work, self.rejected

    def clear(self) -> None:
        """Forget all, and give back what a scan over very many tiles took."""
        if len(self.table) > _KEPT_TILES:
            self._begin()
        self.table[:] = -1
        self.number = 0
        self.rejected[:] = 0

    def double(self) -> None:
        """Twice the room."""
        self.keys = np.append(self.keys, np.zeros_like(self.keys))
        self.work = np.append(self.work, np.zeros_like(self.work))
        self.table = np.empty(2 * len(self.table), np.int32)
        rehash(self.table, self.keys, self.number)


class ThreadScratch:
    """What one thread needs for itself: a block, the tiles of its part, a footprint's shares, a queue."""

    def __init__(self, side: int) -> None:
        self.block = Block(
            np.zeros((PLANES, STRIDE)),
            np.zeros(BLOCK, np.int64),
            np.zeros((4, BLOCK), np.int32),
            np.zeros((4, BLOCK)),
            np.zeros(BLOCK, np.uint8),
        )
        self.tiles = Touched()
        self.lines = np.zeros((5, side + 1))
        self.shares = np.empty(side * side)
        room = QUEUE + max(side * side, 4 * RUN)
        self.queue = Queue(np.empty(room, np.uint64), np.empty(room), np.empty(room, np.int64))


class Workspace:
    """Planes, scratch and threads of one map. ``side``: most cells of a footprint along an axis.

    ``uses``: how often `planes` was called; what it gave before is overwritten.
    """

    def __init__(self, threads: int, side: int) -> None:
        self.threads = threads
        self.side = side
        self.uses = 0
        self._planes = _planes(0)
        self._scratch = [ThreadScratch(side)]
        self._pool: ThreadPoolExecutor | None = None

    @property
    def scratch(self) -> list[ThreadScratch]:
        """One a thread, as far as threads were needed."""
        return self._scratch

    def planes(self, number: int) -> Planes:
        """Planes for ``number`` points, in whole blocks; what they hold is left from before, but ``reason``, 0."""
        self.uses += 1
        blocks = blocks_of(number)
        kept = self._planes
        if blocks > len(kept.weight):
            kept = _planes(max(blocks, 16))
            if number <= _KEPT_POINTS:
                self._planes = kept
        # Views without gaps: kernels are compiled for that layout alone.
        part = Planes._make(array[: blocks if array.ndim == 3 else blocks * BLOCK] for array in kept)
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
            wait(others)  # all of them, also if one fails: none may work on while the next scan begins
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads; they begin anew when they are needed."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
