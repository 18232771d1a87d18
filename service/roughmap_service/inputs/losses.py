"""When a cloud and a stream of messages count as lost: pure functions of what became of them, and when."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from roughmap_schemas.reasons import INTEGRATED, CloudReason, PointReason

ROW: Final = 10
"""A stream is lost when its last ten messages ended badly the same way, and works again after ten good ones, or once
none of the ten ended that way and most of them well."""

WINDOW: Final = 5
"""Seconds over which a stream is lost too if `SHARE` of at least `FEWEST` messages ended badly, whichever way."""

SHARE: Final = 0.9
FEWEST: Final = 5

SILENT: Final = 60.0
"""Seconds without a message after which a stream is no problem any more: its sender was switched off."""

FORGOTTEN: Final = 600.0
"""The same for a stream of which only one message is known, and the most for any: scanners may take minutes."""

NO_ECHO: Final = (PointReason.NO_RETURN, PointReason.NOT_FINITE, PointReason.DUPLICATE_RETURN)
"""Reasons of points where nothing came back. Under an open sky most are like that, and nothing is lost with them."""


class Cause(NamedTuple):
    """How messages end badly: ``kind`` is "cloud", "point", "pose" or "refused", ``reason`` one of its reasons."""

    kind: str
    reason: str


class Outcome(NamedTuple):
    """What became of one message. ``at``: monotonic s; ``cause``: None if it ended well.

    ``accepted`` and ``rejected`` are the numbers of a cloud's points.
    """

    at: float
    cause: Cause | None
    accepted: int = 0
    rejected: Mapping[str, int] = {}


def cloud_cause(outcome: str, accepted: int, rejected: Mapping[str, int]) -> Cause | None:
    """Return how a decided cloud ended badly: not in the map, or without nearly all of its points; None if it is well.

    Points where nothing came back don't count, unless there are no others.
    """
    if outcome != INTEGRATED and not (outcome == CloudReason.EMPTY and rejected):
        return Cause("cloud", str(outcome))
    others = {reason: number for reason, number in rejected.items() if reason not in NO_ECHO}
    counts = others if others or accepted else rejected
    lost = sum(counts.values())
    if lost and lost >= SHARE * (lost + accepted):
        return Cause("point", str(max(counts, key=lambda reason: counts[reason])))
    return None


class _Second:
    """The messages of one second: when the first came, how many there were, and how many of them ended badly."""

    __slots__ = ("bad", "first", "number", "total")

    def __init__(self, number: int, first: float) -> None:
        self.number, self.first, self.total, self.bad = number, first, 0, 0


@dataclass
class Losses:
    """The last messages of one stream; ``lost`` is the cause of its loss, None while it works."""

    lost: Cause | None = None
    last: deque[Outcome] = field(default_factory=lambda: deque(maxlen=ROW))
    _seconds: deque[_Second] = field(default_factory=deque)

    def add(self, outcome: Outcome) -> None:
        """Take the next message, in order of time."""
        if self.last and self.silent(outcome.at):
            self.lost = None
            self.last.clear()
            self._seconds.clear()
        self.last.append(outcome)
        self._count(outcome)
        causes = {each.cause for each in self.last}
        full = len(self.last) == ROW
        bad = [each.cause for each in self.last if each.cause is not None]
        if self.lost is not None and self.lost not in causes and full and 2 * len(bad) < ROW:
            self.lost = None
            self._seconds.clear()
        elif bad and full and len(causes) == 1:
            self.lost = outcome.cause
        elif (self.lost is None and bad and self._mostly_bad(outcome.at)) or (self.lost and self.lost not in causes):
            self.lost = Counter(bad).most_common(1)[0][0]

    def silent(self, now: float) -> bool:
        """Whether nothing has come for so long that the stream counts as ended, at monotonic time ``now`` (s)."""
        number = len(self.last)
        if number < 2:
            return now - self.last[-1].at > FORGOTTEN if number else True
        rate = (self.last[-1].at - self.last[0].at) / (number - 1)
        return now - self.last[-1].at > min(max(SILENT, 3.0 * rate), FORGOTTEN)

    def _count(self, outcome: Outcome) -> None:
        seconds, number = self._seconds, int(outcome.at)
        while seconds and seconds[0].number < number - WINDOW:
            seconds.popleft()
        if not seconds or seconds[-1].number != number:
            seconds.append(_Second(number, outcome.at))
        seconds[-1].total += 1
        seconds[-1].bad += outcome.cause is not None

    def _mostly_bad(self, now: float) -> bool:
        """Whether of the messages of this second and the `WINDOW` before it nearly all ended badly."""
        if now - self._seconds[0].first < WINDOW:
            return False
        total = sum(second.total for second in self._seconds)
        return total >= FEWEST and sum(second.bad for second in self._seconds) >= SHARE * total
