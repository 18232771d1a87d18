"""Counters since the start of the service, from which status, metrics and log lines are made."""

import threading
import time
from bisect import bisect_left
from collections import Counter, deque
from dataclasses import dataclass, field, fields
from typing import Any

MAX_ROBOTS = 256
"""Robots that are counted by name, since each is a series in the metrics."""

LAG_WINDOW_SECONDS = 10.0
"""Period over which lag and rates are reported (given by the design)."""

OVERLOAD_SECONDS = 2.0
"""An overload begins when a message is dropped or refused for lack of room. It ends after this time without another one
and without a late cloud."""

LATE_SECONDS = 1.0
"""A cloud is late if it took `input.max_wait` and this from its arrival: it waited for other clouds, not for poses."""

LAG_SAMPLES = 4096
"""The most clouds that are remembered for the lag: 400 a second over the period."""

RATE_SAMPLES = 20_000
"""The most poses that are remembered for their rate: 2,000 a second over the period."""

BOUNDS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Upper bounds in seconds of the histograms: from the sync of a fast disk to a hopeless lag."""

REFUSED_ROBOTS = 32
"""Robots whose refusals have log lines of their own: times the number of reasons, below `log_lines.MAX_KINDS`."""

OTHERS = "(others)"
"""The name under which robots past the first `MAX_ROBOTS` are counted together; not a valid robot name."""


class Durations:
    """A histogram: the number of durations up to each bound and above the one before it, and their sum in seconds."""

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS) + 1)
        self.total = 0.0

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.counts[bisect_left(BOUNDS, seconds)] += 1
        self.total += seconds

    def copy(self) -> "Durations":
        """Return a histogram of its own."""
        copied = Durations()
        copied.counts, copied.total = list(self.counts), self.total
        return copied


@dataclass
class Lag:
    """Time from arrival to queryable, in seconds; None if no cloud was integrated in the period."""

    p50: float | None
    p99: float | None


@dataclass
class Counts:
    """A consistent copy of all counters."""

    clouds_accepted: int = 0
    clouds_rejected: Counter[str] = field(default_factory=Counter)
    points_accepted: int = 0
    points_rejected: Counter[str] = field(default_factory=Counter)
    poses_accepted: int = 0
    poses_rejected: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    gaps: Counter[str] = field(default_factory=Counter)
    jumps: Counter[str] = field(default_factory=Counter)
    tiles_forgotten: int = 0
    outputs_dropped: Counter[str] = field(default_factory=Counter)
    lag: Durations = field(default_factory=Durations)
    integration: Durations = field(default_factory=Durations)
    log_sync: Durations = field(default_factory=Durations)
    queries: dict[str, Durations] = field(default_factory=lambda: {"ok": Durations()})

    def copy(self) -> "Counts":
        """Return counts of their own."""
        held: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        copied: dict[str, Any] = {
            name: value if isinstance(value, int) else value.copy() for name, value in held.items()
        }
        copied["queries"] = {outcome: durations.copy() for outcome, durations in self.queries.items()}
        return Counts(**copied)


class Counters:
    """Counters that any thread may raise and read. Every change holds one lock for a short time."""

    def __init__(self, max_wait: float = 0.0) -> None:
        self._lock = threading.Lock()
        self._counts = Counts()
        self._refused_robots: set[str] = set()
        self._late = max_wait + LATE_SECONDS
        self._overloaded_until = float("-inf")
        self._recent: deque[tuple[float, float, int]] = deque(maxlen=LAG_SAMPLES)
        self._recent_poses: deque[float] = deque(maxlen=RATE_SAMPLES)

    def cloud(
        self, outcome: str, accepted: int, rejected: dict[str, int], arrival: float | None, seconds: float = 0.0
    ) -> None:
        """Count a decided cloud.

        ``arrival`` is its monotonic time in seconds, None for a cloud from before a restart. Its integration took
        ``seconds``.
        """
        with self._lock:
            now = time.monotonic()
            if outcome == "integrated":
                self._counts.clouds_accepted += 1
                self._counts.integration.add(seconds)
                if arrival is not None:
                    self._counts.lag.add(now - arrival)
                    if now - arrival > self._late and now < self._overloaded_until:
                        self._overloaded_until = now + OVERLOAD_SECONDS
                self._recent.append((now, now - (arrival if arrival is not None else now), accepted))
            else:
                self._counts.clouds_rejected[outcome] += 1
                if outcome == "overload":
                    self._overloaded_until = now + OVERLOAD_SECONDS
            self._counts.points_accepted += accepted
            self._counts.points_rejected.update(rejected)

    def pose(self, reason: str | None) -> None:
        """Count an odometry message that reached the log; ``reason`` is why it was rejected, None if it was not."""
        with self._lock:
            if reason is None:
                self._counts.poses_accepted += 1
                self._recent_poses.append(time.monotonic())
            else:
                self._counts.poses_rejected[reason] += 1

    def refuse(self, code: str, robot: str = OTHERS) -> str:
        """Count a message that never reached the log; return the robot's name for its log line."""
        with self._lock:
            self._counts.refused[code] += 1
            if len(self._refused_robots) < REFUSED_ROBOTS:
                self._refused_robots.add(robot)
            if code == "busy":
                self._overloaded_until = time.monotonic() + OVERLOAD_SECONDS
            return robot if robot in self._refused_robots else OTHERS

    def gap(self, robot: str, missing: int) -> None:
        """Count ``missing`` messages of a robot that were lost on the way here."""
        with self._lock:
            self._counts.gaps[_bounded(robot, self._counts.gaps)] += missing

    def jump(self, robot: str) -> None:
        """Count a jump of a robot's transform."""
        with self._lock:
            self._counts.jumps[_bounded(robot, self._counts.jumps)] += 1

    def forgotten(self, tiles: int) -> None:
        """Count tiles that the map forgot."""
        with self._lock:
            self._counts.tiles_forgotten += tiles

    def output_dropped(self, kind: str) -> None:
        """Count a record of ``kind`` ("queries" or "updates") that found no room in the log's queue."""
        with self._lock:
            self._counts.outputs_dropped[kind] += 1

    def query(self, outcome: str, seconds: float) -> None:
        """Count a query and its time from arrival to last reply; ``outcome`` is "ok" or a `QueryCode`."""
        with self._lock:
            self._counts.queries.setdefault(outcome, Durations()).add(seconds)

    def log_synced(self, seconds: float) -> None:
        """Count an fsync of the log."""
        with self._lock:
            self._counts.log_sync.add(seconds)

    def snapshot(self) -> Counts:
        """Return a copy of all counters."""
        with self._lock:
            return self._counts.copy()

    @property
    def overloaded(self) -> bool:
        """Whether more comes in than can be integrated, or did in the last `OVERLOAD_SECONDS`."""
        with self._lock:
            return time.monotonic() < self._overloaded_until

    def _window(self) -> list[tuple[float, float, int]]:
        since = time.monotonic() - LAG_WINDOW_SECONDS
        with self._lock:
            recent = list(self._recent)
        return [sample for sample in recent if sample[0] >= since]

    def lag(self) -> Lag:
        """Return the time from arrival to queryable over the last `LAG_WINDOW_SECONDS`."""
        lags = sorted(sample[1] for sample in self._window())
        if not lags:
            return Lag(None, None)
        return Lag(lags[len(lags) // 2], lags[min(len(lags) - 1, int(len(lags) * 0.99))])

    def rates(self) -> tuple[float, float, float]:
        """Return clouds, points and poses per second over the last `LAG_WINDOW_SECONDS`."""
        window = self._window()
        since = time.monotonic() - LAG_WINDOW_SECONDS
        with self._lock:
            arrivals = list(self._recent_poses)
        poses = len(arrivals) - bisect_left(arrivals, since)
        points = sum(sample[2] for sample in window)
        return len(window) / LAG_WINDOW_SECONDS, points / LAG_WINDOW_SECONDS, poses / LAG_WINDOW_SECONDS


def _bounded(robot: str, counts: Counter[str]) -> str:
    """Return the name to count a robot under: names come from outside, before the robot was admitted."""
    return robot if robot in counts or len(counts) < MAX_ROBOTS else OTHERS
