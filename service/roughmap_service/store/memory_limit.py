"""The process's memory, held to `map.memory_limit`: beyond it tiles leave for the spill file."""

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

log = logging.getLogger(__name__)

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Of glibc's malloc.h."""

STATM = Path("/proc/self/statm")

BATCH = 64
"""Tiles that leave at a time, 16 MiB: between batches the memory is measured again, and readers have the lock."""

HIGH, LOW = 15 / 16, 7 / 8
"""Parts of the limit: where tiles begin to leave, and how far. The distance keeps it from being at it all the time."""

RETRY_SECONDS = 1.0
"""How long a disk that would not take tiles is left alone."""

TRIM_SECONDS = 5.0
"""How often the allocator is asked to give back what it keeps: it looks through all of it, some milliseconds."""

KEPT_SHARE, MOST_KEPT = 1 / 32, 64 << 20
"""What the allocator may keep of freed memory in each heap: this part of the limit, at most so many bytes."""

HEAPS = 2
"""So many heaps for all threads. With one for each of some twenty, what they kept grew to 60 MiB of a limit of 256
within minutes of an overload; with two nothing did, and nothing became slower."""

Reading = Callable[[], AbstractContextManager[RoughMap]]
"""Holds the map for a short look."""


def memory_bytes() -> int:
    """The process's resident memory; 0 where the system doesn't tell."""
    try:
        handle = os.open(STATM, os.O_RDONLY)  # plainly: it is asked at every scan, and a Path takes three times as long
        try:
            pages = os.read(handle, 256).split()[1]
        finally:
            os.close(handle)
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def keep_freed(limit: int) -> None:
    """Have the C library keep what large answers and messages took for the next ones: by default it gives that back at
    once, and to get 13 MB anew costs 5 ms of page faults, ten times what it takes to fill them."""
    kept = min(int(limit * KEPT_SHARE), MOST_KEPT)
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, kept // 2)
        library.mallopt(M_TRIM_THRESHOLD, kept)
        library.mallopt(M_ARENA_MAX, HEAPS)


def trim_allocator() -> None:
    """Have free memory given back to the system: the C library keeps some for each thread, and with Zenoh's threads
    and ours it came to tens of MiB, for which tiles had to leave. Another C library may not know the call."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


class MemoryLimit:
    """Watches resident memory, less what it was when this was made: before the first tile, when all else was ready.

    Attributes:
        ok: whether tiles could leave when they had to.
        full: whether the limit is passed and tiles can't leave: then the map must not get new ones.
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

    def relieve(self, reading: Reading) -> None:
        """If there is need, take tiles out of memory. Call it where nobody else changes the map meanwhile."""
        if self.taken <= self.limit * HIGH:
            self._say(True, "")
            self.full = False
            return
        if time.monotonic() >= self._trimmed + TRIM_SECONDS:
            trim_allocator()
            self._trimmed = time.monotonic()
        if not self.ok and time.monotonic() < self._retry:
            self.full = self.taken > self.limit
            return
        while (excess := self.taken - int(self.limit * LOW)) > 0:
            number, why = self._evict(reading, min(BATCH, -(-excess // SLOT_BYTES)))
            if why:
                self._say(False, why)
                self._retry = time.monotonic() + RETRY_SECONDS
                self.full = self.taken > self.limit
                return
            if not number:
                break  # what is left is in use, or is no tile
        self._say(True, "")
        self.full = False

    def _evict(self, reading: Reading, number: int) -> tuple[int, str]:
        """How many tiles left, and what was in the way of more; "" if nothing was."""
        try:
            with reading() as rough_map:
                eviction = rough_map.spill(number)
        except MemoryError:  # for the shelf's tables, which grow with what lies there
            return 0, f"{self.spill.path}: no memory to keep account of it"
        why = f"{self.spill.path}: map.spill_limit is reached" if eviction.short else ""
        try:
            eviction.write()
        except (OSError, MemoryError) as error:
            why = f"{self.spill.path}: {error.strerror if isinstance(error, OSError) else 'no memory to write'}"
        finally:
            with reading():
                eviction.close()
        return eviction.number, why

    def _say(self, ok: bool, why: str) -> None:
        if ok and not self.ok:
            note(log, logging.INFO, "memory_relieved", "tiles leave memory again", always=True)
        elif not ok and self.ok:
            text = f"tiles can't leave memory: {why}; beyond map.memory_limit no new ones are taken"
            note(log, logging.WARNING, "memory_full", text, always=True, cause=why)
        self.ok = ok
