"""Memory reused from scan to scan, and the threads that share the work."""

import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F4, F8, I4, I8, U1, U2, U8
from roughmap.cell import PointReason
from roughmap.integration.drains import ENTRY, QUEUE, RUN
from roughmap.integration.range_image import new_image
from roughmap.points.moving import MovingScratch, moving_scratch
from roughmap.points.place import BLOCK, PLANES, STRIDE
from roughmap.tiles.index import rehash

_KEPT_POINTS = 1 << 18
"""Planes for more points than this (about 35 MB) are freed after the call that needed them."""

_KEPT_TILES = 1 << 16
"""A larger table of touched tiles is freed by the next call, since it would have to be cleared for every scan."""

_POINTS_PER_THREAD = 2048
"""Fewer points are not worth a thread."""


def blocks_of(number: int) -> int:
    """Return the number of blocks for ``number`` points."""
    return -(-number // BLOCK)


class Planes(NamedTuple):
    """What phase one leaves of a call's points for phase two: one array per quantity.

    A point is plain if its footprint is at most 2 x 2 cells of one tile, else it is odd. Consecutive plain points of
    the same tile form a run; each odd point is a run of its own.

    For each point, ``x``, ``y`` (written only if the scan clears) and ``z``: position in the map frame, also of
    rejected points that have a pose; ``reason``: see `PointReason`; ``common``: the height's variance from the pose,
    square metres; ``mount``: its standard deviation from the mounting, metres; ``up``: 1 where the point can't be
    ground, 0 in a map of all points; ``q``: weight over share. For plain points, ``corner``: cell (i, j) in its tile;
    ``weight`` (blocks, 4, BLOCK): weights in the cells (i, j), (i+1, j), (i, j+1), (i+1, j+1), negative for the
    largest share, 0 where the share does not count.

    For each run, ``run_start`` to ``run_stop``: its points; ``run_tile``: the row of its tile, or -1 - k for the odd
    point of row k. For each odd point, ``odd_box``: cells i0, j0, i1, j1, inclusive; ``odd_body``: x, y and four
    numbers of the error body; ``odd_tile``: the row of its tile, or if there are several -1 - ``up``. Each part of
    the work writes its runs and odd points from the row on at which its range of points starts.
    """

    x: F8
    y: F8
    z: F8
    reason: U1
    common: F4
    mount: F4
    up: U1
    corner: U2
    q: F8
    weight: F8
    run_start: I4
    run_stop: I4
    run_tile: I4
    odd_box: I4
    odd_body: F8
    odd_tile: I4


def _planes(blocks: int) -> Planes:
    """Allocate planes. The pages of x, y and the rows for odd points stay unallocated until they are written."""
    number = blocks * BLOCK
    return Planes(
        np.empty(number),
        np.empty(number),
        np.empty(number),
        np.zeros(number, np.uint8),
        np.empty(number, np.float32),
        np.empty(number, np.float32),
        np.empty(number, np.uint8),
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
    """Scratch for the block of points in work.

    ``planes`` (PLANES, STRIDE): see `place`. ``moving``: see `moving`. ``kept`` (BLOCK,): see `bodies`. ``cells``
    (4, BLOCK): i0, j0, i1, j1 of the footprints. ``body`` (4, BLOCK): half extents along x and y; for ellipses also rho
    and beta. ``plain``: 1 for plain points.
    """

    planes: F8
    moving: MovingScratch
    kept: U1
    cells: I4
    body: F8
    plain: U1


class TouchedTiles:
    """The tiles that a range of points touches, by key, in a small hash table that doubles when it is half full.

    ``work``: number of points in each tile. ``founded``: 1 for tiles with a point that can be ground. ``number``:
    number of tiles. ``runs``: the row after the last run. ``rejected``: number of points by `PointReason`.
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
        self.founded = np.zeros(512, np.uint8)

    @property
    def arrays(self) -> tuple[I4, U8, I8, U1, I8]:
        """The arrays for the kernels: table, keys, work, founded, rejected."""
        return self.table, self.keys, self.work, self.founded, self.rejected

    def clear(self) -> None:
        """Remove all tiles, and free the memory that a scan over very many tiles took."""
        if len(self.table) > _KEPT_TILES:
            self._begin()
        self.table[:] = -1
        self.founded[:] = 0
        self.number = 0
        self.rejected[:] = 0

    def double(self) -> None:
        """Double the capacity."""
        self.keys = np.append(self.keys, np.zeros_like(self.keys))
        self.work = np.append(self.work, np.zeros_like(self.work))
        self.founded = np.append(self.founded, np.zeros_like(self.founded))
        self.table = np.empty(2 * len(self.table), np.int32)
        rehash(self.table, self.keys, self.number)


class ThreadScratch:
    """The scratch memory of one thread: a block, the shares of a footprint, a queue."""

    def __init__(self, side: int) -> None:
        self.block = Block(
            np.zeros((PLANES, STRIDE)),
            moving_scratch(),
            np.zeros(BLOCK, np.uint8),
            np.zeros((4, BLOCK), np.int32),
            np.zeros((4, BLOCK)),
            np.zeros(BLOCK, np.uint8),
        )
        self.lines = np.zeros((5, side + 1))
        self.shares = np.empty(side * side)
        room = QUEUE + max(side * side, 4 * RUN)
        self.queue = np.empty(room * int(ENTRY) // 8, np.uint64)


class Workspace:
    """Planes, scratch and threads of one map. ``side``: largest number of cells along an axis in a footprint.

    ``uses``: number of calls to `planes`; each call overwrites what the previous one returned. ``image``: that of the
    scan in work.
    """

    def __init__(self, threads: int, side: int) -> None:
        self.threads = threads
        self.side = side
        self.uses = 0
        self.image = new_image()
        self._planes = _planes(0)
        self._scratch = [ThreadScratch(side)]
        self._tiles = [TouchedTiles()]
        self._pool: ThreadPoolExecutor | None = None

    def tiles(self, ranges: int) -> list[TouchedTiles]:
        """Return the touched tiles of so many ranges of points, as the last call left them."""
        while len(self._tiles) < ranges:
            self._tiles.append(TouchedTiles())
        return self._tiles[:ranges]

    def planes(self, number: int) -> Planes:
        """Return planes for ``number`` points, in whole blocks. ``reason`` is 0, all else is left from before."""
        self.uses += 1
        blocks = blocks_of(number)
        kept = self._planes
        if blocks > len(kept.weight):
            kept = _planes(max(blocks, 16))
            if number <= _KEPT_POINTS:
                self._planes = kept
        # Contiguous views: the kernels are compiled for that layout only.
        part = Planes._make(array[: blocks if array.ndim == 3 else blocks * BLOCK] for array in kept)
        part.reason[:] = 0
        return part

    def parts(self, number: int) -> int:
        """Return the number of threads that share the work on ``number`` points."""
        return max(1, min(self.threads, number // _POINTS_PER_THREAD))

    def run(self, parts: int, task: Callable[[int, ThreadScratch], None]) -> None:
        """Call ``task(part, scratch)`` for each part, each in its own thread, the first in the calling one."""
        while len(self._scratch) < parts:
            self._scratch.append(ThreadScratch(self.side))
        if parts > 1 and self._pool is None:
            self._pool = ThreadPoolExecutor(self.threads - 1, "roughmap")
            weakref.finalize(self, self._pool.shutdown, wait=False)
        others = [self._pool.submit(task, n, self._scratch[n]) for n in range(1, parts)] if self._pool else []
        try:
            task(0, self._scratch[0])
        finally:
            wait(others)  # for all, even if one fails: none may still run when the next scan starts
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads; they are started again when needed."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
