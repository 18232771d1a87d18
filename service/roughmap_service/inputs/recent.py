"""What happened to robots and sensors within the last minute and may not last: a leap, a wild stamp, a lost message."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

LISTED: Final = 60.0
"""Seconds for which something is listed after it happened last."""

RENEWED: Final = 1.0
"""Seconds after which a sentence is made anew if it happens again."""

MAX_LISTED: Final = 32
"""Different things that are listed; the one that happened longest ago gives way."""


@dataclass
class _Happened:
    """What happened ``times``, last ``at`` (monotonic s). ``sentence`` was made at ``told_at``."""

    sentence: str
    times: int
    at: float
    told_at: float


class Recent:
    """Remembers what happened lately, by subject and name; any thread may call it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._happened: dict[tuple[str, str], _Happened] = {}
        """Ordered by time; the last one happened last."""

    def add(self, subject: str, name: str, sentence: Callable[[], str]) -> str | None:
        """Take what happened to a subject ("robot r1"). Return its sentence if it was not listed before.

        ``sentence`` begins with the subject; it is called at most once a second.
        """
        with self._lock:
            now = self._clock()
            self._forget(now)
            known = self._happened.pop((subject, name), None)
            if known is None or now - known.told_at >= RENEWED:
                known = _Happened(sentence(), 0 if known is None else known.times, now, now)
            known.times, known.at = known.times + 1, now
            self._happened[subject, name] = known
            if len(self._happened) > MAX_LISTED:
                del self._happened[next(iter(self._happened))]
        return known.sentence if known.times == 1 else None

    def told(self) -> dict[str, str]:
        """Return by subject what happened, and how often and how long ago; what happened last comes first."""
        with self._lock:
            now = self._clock()
            self._forget(now)
            found: dict[str, str] = {}
            for (subject, _), one in reversed(self._happened.items()):
                often = f"{one.times} times, last " if one.times > 1 else ""
                text = f"{one.sentence} ({often}{now - one.at:.0f} s ago)"
                found[subject] = f"{found[subject]}; {text.removeprefix(f'{subject}: ')}" if subject in found else text
        return found

    def _forget(self, now: float) -> None:
        while self._happened:
            first = next(iter(self._happened))
            if now - self._happened[first].at <= LISTED:
                return
            del self._happened[first]
