"""How fast the log grows, how long its disk lasts, and how that is said."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

WINDOW_S: Final = 300.0
"""Time over which the growth is measured: the last minutes."""

LEAST_S: Final = 10.0
"""The shortest time over which it is: less says little."""

STEP_S: Final = 5.0
"""Time between two sizes that are kept."""

HOUR_S: Final = 3600.0

GROWTH: Final = {"bytes_per_hour", "hours_to_full_disk", "keep"}
"""The members of `LogState` that say it."""


class LogGrowth:
    """Measures how fast the log grows, from its size whenever it is asked; any thread may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._sizes: deque[tuple[float, int]] = deque()
        """Times in s, and all bytes written until then."""

    def per_hour(self, written: int) -> int | None:
        """Return the bytes an hour over the last minutes; None in the first seconds.

        ``written`` are all bytes so far, over all files. Call it now and then.
        """
        with self._lock:
            now = self._clock()
            if not self._sizes or now - self._sizes[-1][0] >= STEP_S:
                self._sizes.append((now, written))
            while len(self._sizes) > 1 and now - self._sizes[1][0] >= WINDOW_S:
                self._sizes.popleft()
            since, before = self._sizes[0]
        if now - since < LEAST_S:
            return None
        return max(round((written - before) * HOUR_S / (now - since)), 0)


def hours_to_full(per_hour: int | None, free: int | None, keep: int | None) -> float | None:
    """Return in how many hours a disk with ``free`` bytes is full; None if ``keep`` (`log.keep`) bounds the log, or if
    it does not grow or is unknown."""
    return free / per_hour if per_hour and free is not None and keep is None else None


def growth_text(per_hour: int | None, hours: float | None, keep: int | None) -> str:
    """Return what is said of the log's growth; "" if nothing is known of it."""
    if per_hour is None:
        return ""
    text = f"{size_text(per_hour)} an hour"
    if keep is not None:
        return f"{text}, bounded to {size_text(keep)} by log.keep"
    return f"{text}, the disk is full in {_time(hours)}" if hours is not None else text


def size_text(number: float) -> str:
    """Return a number of bytes for a text."""
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")):
        if number >= unit:
            return f"{number / unit:.1f} {name}"
    return f"{number / 1e3:.0f} kB"


def _time(hours: float) -> str:
    if hours < 2.0:
        return f"{hours * 60.0:.0f} minutes"
    if hours < 72.0:
        return f"{hours:.0f} hours"
    return f"{hours / 24.0:,.0f} days"
