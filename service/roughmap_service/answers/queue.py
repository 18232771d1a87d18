"""Queries that wait for their turn: bounded together, small ones before large ones, none starved."""

import bisect
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from roughmap_schemas.faults import QueryFault
from roughmap_schemas.reasons import QueryCode

LOG = logging.getLogger(__name__)

SMALL_CELLS = 16 * 4096
"""A query of at most so many cells (16 tiles: what a planner asks around its robot) is small. One worker serves only
these, so that readers of whole maps, or ones that stopped reading, can't hold all workers."""

CELLS_A_PLACE = SMALL_CELLS
"""A query waits as if one more had come before it for each so many cells: small before large, yet a large one is
passed by a bounded number of later ones."""


@dataclass(order=True)
class _Waiting:
    rank: int
    cells: int = field(compare=False)
    run: Callable[[], None] = field(compare=False)
    refuse: Callable[[QueryFault], None] = field(compare=False)
    passed: int = field(default=0, compare=False)


class AnswerQueue:
    """A few threads that run jobs of known size.

    At most ``limit`` jobs wait, and the jobs that run hold at most ``max_running_cells`` cells together (a larger one
    runs alone). A job's ``run`` must handle its own errors; one that can't be run is told by its ``refuse``.
    """

    def __init__(self, name: str, workers: int, limit: int, max_running_cells: int) -> None:
        self._limit = limit
        self._max_running_cells = max_running_cells
        self._condition = threading.Condition()
        self._waiting: list[_Waiting] = []
        self._number = 0
        self._running_cells = 0
        self._closed = False
        self._end = math.inf
        # Daemons: one that is stuck in a reply to a client that stopped reading must not hold up the process's end.
        self._threads = [
            threading.Thread(target=self._work, args=(n == 0 and workers > 1,), name=f"{name}-{n}", daemon=True)
            for n in range(workers)
        ]
        # At the end one more, since jobs may hold all others; and the caller must not wait for an asker that stalls.
        self._refuser = threading.Thread(target=self._work, args=(False,), name=f"{name}-end", daemon=True)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def waiting(self) -> int:
        """Jobs that no thread has taken yet."""
        with self._condition:
            return len(self._waiting)

    def submit(self, cells: int, run: Callable[[], None], refuse: Callable[[QueryFault], None]) -> None:
        """Takes a job in; raises ``QueryFault`` (``busy``, ``shutting_down``) at once if it can't.

        Where too many wait, the last of them goes: a small job takes the place of a large one.
        """
        busy = QueryFault(QueryCode.BUSY, f"{self._limit} queries are waiting already; ask again later")
        last = None
        with self._condition:
            if self._closed:
                raise QueryFault(QueryCode.SHUTTING_DOWN, "the service is shutting down")
            job = _Waiting(self._number + cells // CELLS_A_PLACE, cells, run, refuse)
            if len(self._waiting) >= self._limit:
                if not self._waiting or self._waiting[-1] <= job:
                    raise busy
                last = self._waiting.pop()
            self._number += 1  # those alone that wait: else who is turned away a hundred times makes all others late
            bisect.insort(self._waiting, job)
            # Any worker may take a small one; to wake them all costs as much as a small answer.
            self._condition.notify(1 if cells <= SMALL_CELLS else len(self._threads))
        if last is not None:
            last.refuse(busy)

    def close(self, timeout: float = 2.0) -> None:
        """Has what waits refused (``shutting_down``), and waits at most ``timeout`` seconds for that and for what runs.

        A second call waits for no longer than the first.
        """
        with self._condition:
            first, self._closed = not self._closed, True
            self._end = min(self._end, time.monotonic() + timeout)
            self._condition.notify_all()
        if first:
            self._refuser.start()
        for thread in (*self._threads, self._refuser):
            if thread.is_alive():
                thread.join(max(0.0, self._end - time.monotonic()))

    def _take(self, small_only: bool) -> _Waiting | None:
        """The first job in rank that may run now, any after the end; called with the condition held."""
        if self._closed:
            return self._waiting.pop(0) if self._waiting else None
        for place, job in enumerate(self._waiting):
            fits = (
                not job.cells  # such a one holds nothing back, and waits for nobody
                or self._running_cells == 0
                or self._running_cells + job.cells <= self._max_running_cells
            )
            if fits and not (small_only and job.cells > SMALL_CELLS):
                for passed in self._waiting[:place]:
                    passed.passed += 1
                return self._waiting.pop(place)
            if job.passed > self._limit and (not fits or self._running_cells == 0):
                return None  # it was passed often enough: let the others end, and another worker take it
        return None

    def _work(self, small_only: bool) -> None:
        while True:
            with self._condition:
                job = self._take(small_only)
                while job is None and not self._closed:
                    self._condition.wait()
                    job = self._take(small_only)
                if job is None:
                    return
                self._running_cells += job.cells
                closed = self._closed
            try:
                if closed:
                    job.refuse(QueryFault(QueryCode.SHUTTING_DOWN, "the service is shutting down"))
                else:
                    job.run()
            except Exception:  # the thread must outlive it: with each one lost, fewer would answer until none did
                LOG.exception("an answer failed beyond its own care")
            finally:
                with self._condition:
                    self._running_cells -= job.cells
                    if self._waiting:
                        self._condition.notify_all()
                del job  # the closure holds the query: it ends for the asker only when it is let go
