"""What a running service takes of the machine, and whether it stays flat."""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from roughmap_client import RoughMapClient

MIB = 1 << 20


def resident(pid: int) -> int:
    """Bytes of memory that a process holds, as the system counts them."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def beside_tiles(pid: int) -> int:
    """Bytes of memory that hold no tiles. Tiles lie in maps of their own, told by the advice on huge pages that only
    they are given (`roughmap/memory.py`); a tile has from 4 to 256 KiB, so their number would say little."""
    rss = slab = total = 0
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        if line.startswith("Rss:"):
            rss = int(line.split()[1]) * 1024
            total += rss
        elif line.startswith("VmFlags:") and {"nh", "hg"} & set(line.split()):
            slab += rss
    return total - slab


def opened(pid: int) -> int:
    """Its file descriptors."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def threads(pid: int) -> int:
    """Its threads."""
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def size(paths: list[Path]) -> int:
    """Bytes of files that may go while one looks."""
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size
        except FileNotFoundError:
            continue
    return total


@dataclass(frozen=True)
class Allowed:
    """How far a quantity may grow from the end of the warm-up to the end of the run, and why so far."""

    growth: float
    why: str


def growth(seconds: npt.ArrayLike, values: npt.ArrayLike) -> float:
    """How much the values rose over the time: the median of all pairs' slopes (Theil and Sen), so that a few spikes
    and the teeth of a file that rotates don't pass for a trend. At most 300 samples, evenly chosen, are looked at."""
    t, v = np.asarray(seconds, float), np.asarray(values, float)
    chosen = np.unique(np.linspace(0, len(t) - 1, min(len(t), 300)).round().astype(int))
    t, v = t[chosen], v[chosen]
    first, second = np.triu_indices(len(t), 1)
    if not len(first):
        return 0.0
    return float(np.median((v[second] - v[first]) / (t[second] - t[first])) * (t[-1] - t[0]))


class Asking:
    """A planner: asks for the ground around a place again and again from a thread of its own, and keeps how long each
    answer took. A context manager."""

    def __init__(self, client: RoughMapClient, hz: float, side: float = 10.0) -> None:
        self._client = client
        self._period = 1.0 / hz
        self._half = side / 2
        self.place = (0.0, 0.0)
        self._lock = threading.Lock()
        self._taken: list[float] = []
        self.asked = 0
        self.failed: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def taken(self) -> list[float]:
        """The seconds of the answers since this was last asked."""
        with self._lock:
            taken, self._taken = self._taken, []
        return taken

    def _run(self) -> None:
        while not self._stop.is_set():
            (x, y), half = self.place, self._half
            begun = time.monotonic()
            self.asked += 1
            try:
                self._client.region((x - half, y - half, x + half, y + half), ["mean_height", "slope"])
            except Exception as error:  # noqa: BLE001 - whatever it is, it is told at the end
                if not self._stop.is_set():
                    self.failed.append(f"{type(error).__name__}: {error}"[:200])
            else:
                with self._lock:
                    self._taken.append(time.monotonic() - begun)
            self._stop.wait(max(begun + self._period - time.monotonic(), 0.0))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(30.0)


def p99(values: list[float]) -> float:
    """The 99th percentile; NaN of none."""
    return float(np.quantile(values, 0.99)) if values else float("nan")
