"""What the service counts since its start, for the status."""

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field

LAG_WINDOW = 10.0
"""Seconds over which lag and rates are told (the design's)."""

OVERLOAD_SECONDS = 2.0
"""So long after the last cloud dropped for want of room the service still counts as overloaded."""

LAG_SAMPLES = 4096
"""At most so many clouds are remembered for the lag: 400 a second over the window."""

RATE_SAMPLES = 20_000
"""At most so many poses are remembered for their rate: 2,000 a second over the window."""


@dataclass
class Lag:
    """Arrival to queryable, in seconds; None where no cloud was integrated in the window."""

    p50: float | None
    p99: float | None


@dataclass
class Counts:
    """One consistent copy of all counters."""

    clouds_accepted: int = 0
    clouds_rejected: Counter[str] = field(default_factory=Counter)
    points_accepted: int = 0
    points_rejected: Counter[str] = field(default_factory=Counter)
    poses_accepted: int = 0
    poses_rejected: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    gaps: Counter[str] = field(default_factory=Counter)
    jumps: Counter[str] = field(default_factory=Counter)
    outputs_dropped: int = 0


class Counters:
    """Counters that any thread may raise and read; every change is one short hold of one lock."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counts()
        self._last_overload = float("-inf")
        self._recent: deque[tuple[float, float, int]] = deque(maxlen=LAG_SAMPLES)
        self._recent_poses: deque[float] = deque(maxlen=RATE_SAMPLES)

    def cloud(self, outcome: str, accepted: int, rejected: dict[str, int], arrival: float | None) -> None:
        """One decided cloud; ``arrival`` is its monotonic time in seconds (None: taken up again after a restart)."""
        with self._lock:
            if outcome == "integrated":
                self._counts.clouds_accepted += 1
                now = time.monotonic()
                self._recent.append((now, now - (arrival if arrival is not None else now), accepted))
            else:
                self._counts.clouds_rejected[outcome] += 1
                if outcome == "overload":
                    self._last_overload = time.monotonic()
            self._counts.points_accepted += accepted
            self._counts.points_rejected.update(rejected)

    def pose(self, reason: str | None) -> None:
        """One odometry message that reached the log: accepted, or the reason why not."""
        with self._lock:
            if reason is None:
                self._counts.poses_accepted += 1
                self._recent_poses.append(time.monotonic())
            else:
                self._counts.poses_rejected[reason] += 1

    def refuse(self, code: str) -> None:
        """One message that never reached the log."""
        with self._lock:
            self._counts.refused[code] += 1
            if code == "busy":
                self._last_overload = time.monotonic()

    def gap(self, robot: str, missing: int) -> None:
        """``missing`` messages of a robot were lost on the way here."""
        with self._lock:
            self._counts.gaps[robot] += missing

    def jump(self, robot: str) -> None:
        """A robot's transform jumped."""
        with self._lock:
            self._counts.jumps[robot] += 1

    def output_dropped(self) -> None:
        """One record of an answer or an update found no room on its way to the log."""
        with self._lock:
            self._counts.outputs_dropped += 1

    def snapshot(self) -> Counts:
        """A copy that no longer changes."""
        with self._lock:
            c = self._counts
            return Counts(
                c.clouds_accepted, Counter(c.clouds_rejected), c.points_accepted, Counter(c.points_rejected),
                c.poses_accepted, Counter(c.poses_rejected), Counter(c.refused), Counter(c.gaps), Counter(c.jumps),
                c.outputs_dropped,
            )  # fmt: skip

    @property
    def overloaded(self) -> bool:
        """Clouds were dropped for want of room within the last seconds."""
        with self._lock:
            return time.monotonic() - self._last_overload < OVERLOAD_SECONDS

    def _window(self) -> list[tuple[float, float, int]]:
        since = time.monotonic() - LAG_WINDOW
        with self._lock:
            return [sample for sample in self._recent if sample[0] >= since]

    def lag(self) -> Lag:
        """Arrival to queryable over the last seconds."""
        lags = sorted(sample[1] for sample in self._window())
        if not lags:
            return Lag(None, None)
        return Lag(lags[len(lags) // 2], lags[min(len(lags) - 1, int(len(lags) * 0.99))])

    def rates(self) -> tuple[float, float, float]:
        """Clouds, points and poses a second over the last seconds."""
        window = self._window()
        since = time.monotonic() - LAG_WINDOW
        with self._lock:
            poses = sum(arrival >= since for arrival in self._recent_poses)
        return len(window) / LAG_WINDOW, sum(sample[2] for sample in window) / LAG_WINDOW, poses / LAG_WINDOW
