"""Keeping the process's memory within `map.memory_limit` by moving tiles to the spill file."""

import contextlib
import ctypes
import logging
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from roughmap import RoughMap
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_service.host.log_lines import note
from roughmap_service.store.spill import Spill

logger = logging.getLogger(__name__)

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Parameters of mallopt, from glibc's malloc.h."""

STATM = Path("/proc/self/statm")

BATCH_TILES = 64
"""Tiles that leave at a time, 21 to 37 MiB. Between batches the memory is measured again, and readers get the lock."""

HIGH, LOW = 15 / 16, 7 / 8
"""Shares of the limit: above HIGH, tiles leave until memory is below LOW. Without the gap some would always leave."""

RETRY_SECONDS = 1.0
"""Pause after the disk refused tiles."""

TRIM_SECONDS = 5.0
"""The least time between two trims of the allocator, each of which takes some milliseconds."""

KEPT_SHARE, MAX_KEPT_BYTES = 1 / 32, 64 << 20
"""Freed memory that the allocator may keep in each heap: this share of the limit, at most this many bytes."""

HEAPS = 2
"""Heaps for all threads. With one heap for each of some twenty threads, the memory they kept grew to 60 MiB of a limit
of 256 MiB within minutes of an overload. With two it did not grow, and nothing became slower."""

HoldMap = Callable[[], AbstractContextManager[RoughMap]]
"""Locks the map for a short time."""


def memory_bytes() -> int:
    """Return the process's resident memory in bytes; 0 if the system does not say."""
    try:
        handle = os.open(STATM, os.O_RDONLY)  # at every scan; reading through a Path takes three times as long
        try:
            pages = os.read(handle, 256).split()[1]
        finally:
            os.close(handle)
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def keep_freed(limit: int) -> None:
    """Let the C library keep the memory of large replies and messages for the next ones.

    By default it returns such memory to the system at once. Getting 13 MB back takes 5 ms of page faults, ten times as
    long as filling them. ``limit`` is `map.memory_limit` in bytes.
    """
    kept = min(int(limit * KEPT_SHARE), MAX_KEPT_BYTES)
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, kept // 2)
        library.mallopt(M_TRIM_THRESHOLD, kept)
        library.mallopt(M_ARENA_MAX, HEAPS)


def trim_allocator() -> None:
    """Return free memory to the system, if the C library has that call.

    glibc keeps some for each thread. With Zenoh's threads and ours that was tens of MiB, for which tiles had to leave.
    """
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


class MemoryLimit:
    """Measures resident memory against ``limit`` bytes, and moves tiles to the spill file when it is near.

    What the process has when this is created does not count: that is before the first tile, when all else is ready.

    Attributes:
        ok: whether tiles could leave memory the last time they had to.
        full: whether the limit is exceeded and tiles can't leave. The map must not get new tiles then.
    """

    def __init__(self, limit: int, spill: Spill, *, measure: Callable[[], int] = memory_bytes) -> None:
        self.limit = limit
        self.spill = spill
        self.ok = True
        self.full = False
        self._measure = measure
        self._before = measure()
        self._retry = 0.0
        self._trimmed = 0.0

    @property
    def taken(self) -> int:
        """Bytes that count against the limit."""
        return self._measure() - self._before

    def relieve(self, hold_map: HoldMap) -> None:
        """Move tiles out of memory if it is near the limit. Nothing else may change the map meanwhile."""
        if self.taken <= self.limit * HIGH:
            self._report(True, "")
            self.full = False
            return
        if time.monotonic() >= self._trimmed + TRIM_SECONDS:
            trim_allocator()
            self._trimmed = time.monotonic()
        if not self.ok and time.monotonic() < self._retry:
            self.full = self.taken > self.limit
            return
        while (excess := self.taken - int(self.limit * LOW)) > 0:
            number, cause = self._evict(hold_map, min(BATCH_TILES, -(-excess // SLOT_BYTES)))
            if cause:
                self._report(False, cause)
                self._retry = time.monotonic() + RETRY_SECONDS
                self.full = self.taken > self.limit
                return
            if not number:
                break  # the rest is in use, or not tiles
        self._report(True, "")
        self.full = False

    def _evict(self, hold_map: HoldMap, number: int) -> tuple[int, str]:
        """Move up to ``number`` tiles; return how many left, and what kept others from leaving ("" if nothing did)."""
        try:
            with hold_map() as rough_map:
                eviction = rough_map.spill(number)
        except MemoryError:  # for the shelf's tables, which grow with the number of tiles
            return 0, f"{self.spill.path}: no memory for its tables"
        cause = f"{self.spill.path}: map.spill_limit is reached" if eviction.short else ""
        try:
            eviction.write()
        except (OSError, MemoryError) as error:
            cause = f"{self.spill.path}: {error.strerror if isinstance(error, OSError) else 'no memory to write'}"
        finally:
            with hold_map():
                eviction.close()
        return eviction.number, cause

    def _report(self, ok: bool, cause: str) -> None:
        if ok and not self.ok:
            note(logger, logging.INFO, "memory_relieved", "tiles leave memory again", always=True)
        elif not ok and self.ok:
            text = f"tiles can't leave memory ({cause}); beyond map.memory_limit the map takes no new tiles"
            note(logger, logging.WARNING, "memory_full", text, always=True, cause=cause)
        self.ok = ok
