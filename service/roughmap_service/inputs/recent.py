"""What happened to robots and sensors within the last minute and may not last: a leap, a wild stamp, a lost message."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from roughmap_service.inputs.remedies import Subject

LISTED: Final = 60.0
"""Seconds for which something is listed after it happened last, and after which it is told again if it goes on."""

RENEWED: Final = 1.0
"""Seconds after which a sentence is made anew if it happens again."""

MAX_LISTED: Final = 32
"""Lines of the list."""

MAX_KEPT, MAX_OF_ROBOT = 1024, 16
"""Different things that are remembered, and of them those of one robot; what happened longest ago gives way."""


@dataclass
class _Happened:
    """What happened ``times``, last ``at`` (monotonic s). ``sentence`` was made ``made`` and told ``told``."""

    sentence: str
    made: float
    told: float
    times: int = 0
    at: float = 0.0


class Recent:
    """Remembers what happened lately, by subject and name; any thread may call it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._happened: dict[tuple[Subject, str], _Happened] = {}
        """Ordered by time; the last one happened last."""
        self._of_robot: dict[str, int] = {}

    def add(self, subject: Subject, name: str, sentence: Callable[[], str]) -> str | None:
        """Take what happened to a robot or to its sensor. Return its sentence if it is to be told.

        That is where it was not listed, and once in `LISTED` while it goes on. ``sentence`` begins with the subject; it
        is called at most once a second.
        """
        key, robot = (subject, name), subject.robot
        with self._lock:
            now = self._clock()
            self._forget(now)
            known = self._happened.get(key)
            if known is None:
                known = _Happened(sentence(), now, now)
                self._make_room(robot)
                self._of_robot[robot] = self._of_robot.get(robot, 0) + 1
            else:
                if now - known.made >= RENEWED:
                    known.sentence, known.made = sentence(), now
                del self._happened[key]
            known.times, known.at = known.times + 1, now
            self._happened[key] = known
            if known.times > 1 and now - known.told < LISTED:
                return None
            known.told = now
            return known.sentence

    def drop(self, subject: Subject, name: str) -> None:
        """Forget it: it is told elsewhere now."""
        with self._lock:
            if (subject, name) in self._happened:
                self._remove((subject, name))

    def told(self) -> list[str]:
        """Return what happened, how often and how long ago, a line each; what happened last comes first."""
        with self._lock:
            now = self._clock()
            self._forget(now)
            found: list[str] = []
            for one in reversed(self._happened.values()):
                if len(found) == MAX_LISTED - 1 and len(self._happened) > MAX_LISTED:
                    found.append(f"{len(self._happened) - len(found)} more events of the last minute; see the log")
                    break
                often = f"{one.times} times, last " if one.times > 1 else ""
                found.append(f"{one.sentence} ({often}{now - one.at:.0f} s ago)")
        return found

    def _make_room(self, robot: str) -> None:
        """Forget the oldest where the robot, or all together, have as many as are kept."""
        if self._of_robot.get(robot, 0) >= MAX_OF_ROBOT:
            self._remove(next(key for key in self._happened if key[0].robot == robot))
        elif len(self._happened) >= MAX_KEPT:
            self._remove(next(iter(self._happened)))

    def _forget(self, now: float) -> None:
        while self._happened:
            first = next(iter(self._happened))
            if now - self._happened[first].at <= LISTED:
                return
            self._remove(first)

    def _remove(self, key: tuple[Subject, str]) -> None:
        del self._happened[key]
        robot = key[0].robot
        self._of_robot[robot] -= 1
        if not self._of_robot[robot]:
            del self._of_robot[robot]
