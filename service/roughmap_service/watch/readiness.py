"""The problems of the service, and what they mean: is it ready, and which word describes its health."""

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

from roughmap_schemas.messages import LogState, MapStatus
from roughmap_service.inputs.streams import limited

STALLED_SECONDS = 10.0
"""The sequencer counts as stalled after this time without a turn. When idle it turns twice a second; when busy, a turn
takes as long as a scan."""


class Problem(StrEnum):
    """What can be wrong with a service."""

    STARTING = "starting"
    SHUTTING_DOWN = "shutting_down"
    SEQUENCER_DEAD = "sequencer_dead"
    SEQUENCER_STALLED = "sequencer_stalled"
    LOG_NOT_WRITABLE = "log_not_writable"
    MEMORY_FULL = "memory_full"
    SNAPSHOT_FAILED = "snapshot_failed"
    OVERLOADED = "overloaded"
    INPUT_LOST = "input_lost"


SUBJECTS: Final = {
    Problem.STARTING: "service",
    Problem.SHUTTING_DOWN: "service",
    Problem.SEQUENCER_STALLED: "sequencer",
    Problem.SEQUENCER_DEAD: "sequencer",
    Problem.LOG_NOT_WRITABLE: "log",
    Problem.MEMORY_FULL: "memory",
    Problem.SNAPSHOT_FAILED: "store",
    Problem.OVERLOADED: "overload",
}
"""Under which subject a status lists a problem. Lost input has the robots and sensors as subjects."""

NOT_BLOCKING = frozenset({Problem.SNAPSHOT_FAILED, Problem.INPUT_LOST})
"""Problems with which the service still accepts messages and answers queries: it stays ready, but is `degraded`."""


def is_ready(problems: Collection[Problem]) -> bool:
    """Return whether a service with these problems accepts messages and answers queries."""
    return NOT_BLOCKING.issuperset(problems)


def health_of(problems: Collection[Problem]) -> Literal["ok", "overloaded", "degraded"]:
    """Return the status's word for these problems."""
    if not problems:
        return "ok"
    return "overloaded" if set(problems) == {Problem.OVERLOADED} else "degraded"


def told(problems: Mapping[Problem, str], lost: Mapping[str, str]) -> dict[str, str]:
    """Return what a status lists: the sentence on each subject, those of the service first, then what is lost."""
    found = {SUBJECTS[problem]: text for problem, text in problems.items() if problem is not Problem.INPUT_LOST}
    return limited({**found, **lost})


OVERLOADED_TEXT = "input arrives faster than it can be integrated; the oldest clouds are dropped and counted"


class Readiness:
    """Holds the current source of problems; any thread may ask, from before recovery until after the last snapshot."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._look: Callable[[], Mapping[Problem, str]] = lambda: {Problem.STARTING: "the map is being recovered"}

    def become(self, look: Callable[[], Mapping[Problem, str]]) -> None:
        """From now on, take the problems, each with its cause, from ``look``."""
        with self._lock:
            self._look = look

    def end(self) -> None:
        """Report that the service is shutting down."""
        self.become(lambda: {Problem.SHUTTING_DOWN: "the service is shutting down"})

    def problems(self) -> dict[Problem, str]:
        """Return the current problems, each with its cause."""
        with self._lock:
            look = self._look
        return dict(look())


def running_problems(
    *,
    alive: bool,
    turned: float,
    failure: BaseException | None,
    log_ok: bool,
    log_error: str,
    memory_ok: bool,
    store_ok: bool,
    store_error: str,
    overloaded: bool,
    lost: Collection[str] = (),
) -> dict[Problem, str]:
    """Return the problems of a running service.

    ``turned`` is the monotonic time, in seconds, at which the sequencer began its last turn; ``lost`` are the sentences
    on robots and sensors whose messages come to nothing, which become one text of a line each.
    """
    found: dict[Problem, str] = {}
    idle_s = time.monotonic() - turned
    if not alive:
        found[Problem.SEQUENCER_DEAD] = f"the sequencer failed: {failure}"
    elif idle_s > STALLED_SECONDS:
        why = f"the sequencer has done nothing for {idle_s:.0f} s: it or its disk hangs"
        found[Problem.SEQUENCER_STALLED] = why
    if not log_ok:
        found[Problem.LOG_NOT_WRITABLE] = f"the log can't be written: {log_error}"
    if not memory_ok:
        found[Problem.MEMORY_FULL] = "tiles can't be spilled; past map.memory_limit, clouds with new tiles are rejected"
    if not store_ok:
        found[Problem.SNAPSHOT_FAILED] = f"the store can't be written: {store_error}; the log holds everything"
    if overloaded:
        found[Problem.OVERLOADED] = OVERLOADED_TEXT
    if lost:
        found[Problem.INPUT_LOST] = "\n".join(lost)
    return found


@dataclass
class Sources:
    """Where the pages get what they show. A source that is None is not available yet."""

    readiness: Readiness
    map: str = ""
    url: str | None = None
    recent: Callable[[], Sequence[str]] = list
    log: Callable[[], LogState] = LogState
    status: Callable[[], MapStatus] | None = None
    metrics: Callable[[], bytes] | None = None
