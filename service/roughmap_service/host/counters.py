"""What the service counts since its start: the one source of status, metrics and log lines."""

import threading
import time
from bisect import bisect_left
from collections import Counter, deque
from copy import deepcopy
from dataclasses import dataclass, field

MAX_ROBOTS = 256
"""Robots that are counted each by its name: so many series the metrics may have."""

LAG_WINDOW = 10.0
"""Seconds over which lag and rates are told (the design's)."""

OVERLOAD_SECONDS = 2.0
"""An overload begins when a message is dropped or turned away for want of room. It ends when for so long none was, and
no cloud came into the map late."""

LATE_SECONDS = 1.0
"""A cloud is late past `input.max_wait` and this after its arrival: it waited for other clouds then, not for poses."""

LAG_SAMPLES = 4096
"""At most so many clouds are remembered for the lag: 400 a second over the window."""

RATE_SAMPLES = 20_000
"""At most so many poses are remembered for their rate: 2,000 a second over the window."""

BOUNDS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Upper bounds in seconds under which durations are counted: from a fast disk's sync to a hopeless lag."""

REFUSED_ROBOTS = 32
"""Robots whose refusals are told apart in the log: with each reason, fewer than `logs.MAX_KINDS`."""

OTHERS = "(others)"
"""The robots past the first `MAX_ROBOTS`, counted together; no robot can be named so."""


class Durations:
    """How many durations lay at or below each bound (the last count: above all), and their sum in seconds."""

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS) + 1)
        self.total = 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        self.counts[bisect_left(BOUNDS, seconds)] += 1
        self.total += seconds


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
    outputs_dropped: Counter[str] = field(default_factory=Counter)
    lag: Durations = field(default_factory=Durations)
    integration: Durations = field(default_factory=Durations)
    log_sync: Durations = field(default_factory=Durations)
    queries: dict[str, Durations] = field(default_factory=lambda: {"ok": Durations()})


class Counters:
    """Counters that any thread may raise and read; every change is one short hold of one lock."""

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
        """One decided cloud; ``arrival`` is its monotonic time in seconds (None: taken up again after a restart),
        ``seconds`` how long its integration took."""
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
        """One odometry message that reached the log: accepted, or the reason why not."""
        with self._lock:
            if reason is None:
                self._counts.poses_accepted += 1
                self._recent_poses.append(time.monotonic())
            else:
                self._counts.poses_rejected[reason] += 1

    def refuse(self, code: str, robot: str = OTHERS) -> str:
        """One message that never reached the log; returns the name under which to tell of it."""
        with self._lock:
            self._counts.refused[code] += 1
            if len(self._refused_robots) < REFUSED_ROBOTS:
                self._refused_robots.add(robot)
            if code == "busy":
                self._overloaded_until = time.monotonic() + OVERLOAD_SECONDS
            return robot if robot in self._refused_robots else OTHERS

    def gap(self, robot: str, missing: int) -> None:
        """``missing`` messages of a robot were lost on the way here."""
        with self._lock:
            self._counts.gaps[_bounded(robot, self._counts.gaps)] += missing

    def jump(self, robot: str) -> None:
        """A robot's transform jumped."""
        with self._lock:
            self._counts.jumps[_bounded(robot, self._counts.jumps)] += 1

    def output_dropped(self, kind: str) -> None:
        """One record of an answer ("queries") or an update ("updates") found no room on its way to the log."""
        with self._lock:
            self._counts.outputs_dropped[kind] += 1

    def query(self, outcome: str, seconds: float) -> None:
        """One query, from its arrival to its last reply; ``outcome`` is "ok" or a `QueryCode`."""
        with self._lock:
            self._counts.queries.setdefault(outcome, Durations()).add(seconds)

    def log_synced(self, seconds: float) -> None:
        """The log was brought to the disk."""
        with self._lock:
            self._counts.log_sync.add(seconds)

    def snapshot(self) -> Counts:
        """A copy that no longer changes."""
        with self._lock:
            return deepcopy(self._counts)

    @property
    def overloaded(self) -> bool:
        """Whether more comes in than can be integrated, or did until a moment ago (`OVERLOAD_SECONDS`)."""
        with self._lock:
            return time.monotonic() < self._overloaded_until

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


def _bounded(robot: str, counts: Counter[str]) -> str:
    """The name to count a robot under: names come from outside, before it is known whether the robot is let in."""
    return robot if robot in counts or len(counts) < MAX_ROBOTS else OTHERS
