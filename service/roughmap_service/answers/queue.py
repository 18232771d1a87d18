"""Planned queries that wait for a worker: bounded together, small before large, none starved."""

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

logger = logging.getLogger(__name__)

SMALL_CELLS = 16 * 4096
"""Cells of the largest small query: 16 tiles, what a planner asks for around its robot. One worker serves only small
queries, so that readers of whole maps, or readers that stalled, cannot occupy all workers."""

CELLS_A_PLACE = SMALL_CELLS
"""For every 16 tiles a query waits as if it had arrived one query later. So small queries go first, yet only a bounded
number of later queries passes a large one."""


@dataclass(order=True)
class _Waiting:
    rank: int
    cells: int = field(compare=False)
    run: Callable[[], None] = field(compare=False)
    refuse: Callable[[QueryFault], None] = field(compare=False)
    passed: int = field(default=0, compare=False)


class AnswerQueue:
    """A few threads that run jobs of known size.

    At most ``limit`` jobs wait. Running jobs hold at most ``max_running_cells`` cells together; a larger job runs
    alone. A job's ``run`` must handle its own errors; ``refuse`` is called for a job that cannot run.
    """

    def __init__(self, name: str, workers: int, limit: int, max_running_cells: int) -> None:
        self._name = name
        self._limit = limit
        self._max_running_cells = max_running_cells
        self._condition = threading.Condition()
        self._waiting: list[_Waiting] = []
        self._number = 0
        self._running_cells = 0
        self._closed = False
        self._end = math.inf
        # Daemons: a thread that is stuck in a reply to a stalled client must not keep the process from ending.
        self._threads = [
            threading.Thread(target=self._work, args=(n == 0 and workers > 1,), name=f"{name}-{n}", daemon=True)
            for n in range(workers)
        ]
        # Refuses waiting jobs at shutdown: jobs may occupy all workers, and `close` must not wait for a stalled client.
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
        """Queue a job; raise QueryFault (``busy``, ``shutting_down``) at once if it cannot be queued.

        If the queue is full, the job that ranks last is refused: a small job takes the place of a large one.
        """
        busy = QueryFault(QueryCode.BUSY, f"{self._limit} queries already wait (query.queue_limit); ask again later")
        last = None
        with self._condition:
            if self._closed:
                raise QueryFault(QueryCode.SHUTTING_DOWN, "the service is shutting down")
            job = _Waiting(self._number + cells // CELLS_A_PLACE, cells, run, refuse)
            if len(self._waiting) >= self._limit:
                if not self._waiting or self._waiting[-1] <= job:
                    raise busy
                last = self._waiting.pop()
            self._number += 1  # counts queued jobs only: a client that is refused in a loop must not delay others
            bisect.insort(self._waiting, job)
            # Any worker may take a small job; waking all of them costs as much as a small answer.
            self._condition.notify(1 if cells <= SMALL_CELLS else len(self._threads))
        if last is not None:
            last.refuse(busy)

    def close(self, timeout: float = 2.0) -> None:
        """Refuse waiting jobs (``shutting_down``); wait at most ``timeout`` seconds for that and for running jobs.

        A second call does not extend the wait.
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
        """Return the first job in rank that may run now (after `close`, any job); the condition must be held."""
        if self._closed:
            return self._waiting.pop(0) if self._waiting else None
        for place, job in enumerate(self._waiting):
            fits = (
                not job.cells  # reads no cells, so the bound does not concern it
                or self._running_cells == 0
                or self._running_cells + job.cells <= self._max_running_cells
            )
            if fits and not (small_only and job.cells > SMALL_CELLS):
                for passed in self._waiting[:place]:
                    passed.passed += 1
                return self._waiting.pop(place)
            if job.passed > self._limit and (not fits or self._running_cells == 0):
                return None  # passed often enough: wait until it fits or another worker takes it
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
            except Exception:  # a thread that ended would be missing until the next start
                logger.exception("a job of the %s queue failed", self._name)
            finally:
                with self._condition:
                    self._running_cells -= job.cells
                    if self._waiting:
                        self._condition.notify_all()
                del job  # its closure holds the query, which ends for the client only when it is released
