"""Messages lost on the way, counted from the numbers that publishers give theirs.

A robot may have several publishers of a kind, each with a count of its own, or one count for all kinds; and each may
restart. Where Zenoh names the publisher, its own numbers tell. Elsewhere a number belongs to the count it continues.
"""

import threading
from dataclasses import dataclass, field
from typing import Final

from roughmap_schemas.kinds import Kind

MAX_PUBLISHERS: Final = 10_000
"""Robots, and publishers that Zenoh names, whose numbers are kept. The one that was silent longest is forgotten."""

MAX_COUNTS: Final = 16
"""Counts of one robot that are told apart."""

MAX_GAP: Final = 1 << 32
"""A larger step begins another count."""

WAIT: Final = 8
"""Messages of the kind after which a number that was skipped counts as lost. If its count goes on before, the number
that came instead was another publisher's. Where so many in a row belonged to one count, there is no need to wait."""

RECENT: Final = 32
"""A count that so many messages of the kind did not belong to has no losses."""


@dataclass(eq=False, slots=True)
class _Count:
    """One publisher's count: its last number, and for each kind when it was heard, in messages of the kind.

    It may have begun with a step of ``missing`` numbers from the end of another one, ``before``, at ``since``.
    """

    last: int = 0
    heard: dict[Kind, int] = field(default_factory=dict)
    before: "_Count | None" = None
    missing: int = 0
    since: tuple[Kind, int] = (Kind.POINTS, 0)


@dataclass(slots=True)
class _Robot:
    """The counts of one robot, the one that was heard last at the end."""

    counts: list[_Count] = field(default_factory=list)
    heard: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    in_a_row: dict[Kind, tuple[_Count, int]] = field(default_factory=dict)

    def take(self, kind: Kind, number: int) -> int:
        """Take the number of a message; return how many are lost, as far as that is known now."""
        self.heard[kind] += 1
        missing = 0
        going_on = [count for count in self.counts if count.last + 1 == number]
        if going_on:
            count = max(going_on, key=lambda count: count.heard.get(kind, 0))
            for other in self.counts:
                if other.before is count:
                    other.before = None
        else:
            count, missing = self._step(kind, number)
        last, times = self.in_a_row.get(kind, (count, 0))
        self.in_a_row[kind] = count, times + 1 if last is count else 1
        if count in self.counts:
            self.counts.remove(count)
        self.counts.append(count)
        count.last, count.heard[kind] = number, self.heard[kind]
        return missing + self._settled()

    def _step(self, kind: Kind, number: int) -> tuple[_Count, int]:
        """Return the count of a number that continues none, and how many are lost for certain."""
        oldest = max(self.heard[kind] - RECENT, 1)
        below = [count for count in self.counts if count.last < number and count.heard.get(kind, 0) >= oldest]
        before = max(below, key=lambda count: (count.last, count.heard[kind]), default=None)
        if before is None or number - before.last > MAX_GAP:
            return _Count(), 0
        # Numbers up to the end of any other count may have come as messages of another kind.
        missing = number - max(count.last for count in self.counts if count.last < number) - 1
        last, times = self.in_a_row[kind]
        if before is last and times >= WAIT:
            return before, missing
        return _Count(0, dict(before.heard), before, missing, (kind, self.heard[kind])), 0

    def _settled(self) -> int:
        """Return how many numbers are lost because the counts before them did not go on."""
        lost = 0
        for count in list(self.counts):
            kind, since = count.since
            if count.before is not None and self.heard[kind] - since >= WAIT:
                lost += count.missing
                if count.before in self.counts:
                    self.counts.remove(count.before)
                count.before = None
        del self.counts[:-MAX_COUNTS]
        return lost


class Gaps:
    """The numbers of all publishers; for any thread."""

    def __init__(self, max_publishers: int = MAX_PUBLISHERS) -> None:
        self._max_publishers = max_publishers
        self._robots: dict[str, _Robot] = {}
        self._sources: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()

    def numbered(self, robot: str, kind: Kind, number: int) -> int:
        """Take a number from an unnamed publisher; return how many messages are lost, as far as that is known now."""
        with self._lock:
            counts = self._robots.pop(robot, None) or _Robot()
            self._robots[robot] = counts
            if len(self._robots) > self._max_publishers:
                del self._robots[next(iter(self._robots))]
            return counts.take(kind, number)

    def sourced(self, key: str, source: str, number: int) -> int:
        """Take a number that Zenoh gave a message of the publisher ``source``; return how many before it are lost."""
        with self._lock:
            last = self._sources.pop((key, source), None)
            self._sources[key, source] = number
            if len(self._sources) > self._max_publishers:
                del self._sources[next(iter(self._sources))]
        step = 1 if last is None else number - last
        return step - 1 if 1 < step <= MAX_GAP else 0
