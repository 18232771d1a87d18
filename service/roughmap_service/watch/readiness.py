"""What is wrong with the service, whether it takes in and answers in spite of it, and the one word for its health."""

import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from roughmap_schemas.messages import MapStatus

STALLED_SECONDS = 10.0
"""The sequencer turns twice a second even when idle, and for as long as one scan takes when busy: if it has not for so
long, it hangs, or its disk does."""


class Problem(StrEnum):
    """What may be wrong with a service."""

    STARTING = "starting"
    SHUTTING_DOWN = "shutting_down"
    SEQUENCER_DEAD = "sequencer_dead"
    SEQUENCER_STALLED = "sequencer_stalled"
    LOG_NOT_WRITABLE = "log_not_writable"
    MEMORY_FULL = "memory_full"
    SNAPSHOT_FAILED = "snapshot_failed"
    OVERLOADED = "overloaded"


HINDERS_NOTHING = frozenset({Problem.SNAPSHOT_FAILED})
"""It takes in and answers all the same, so it stays ready, though its health says `degraded`."""


def is_ready(problems: Collection[Problem]) -> bool:
    """Whether it takes in and answers in spite of them."""
    return HINDERS_NOTHING.issuperset(problems)


def health_of(problems: Collection[Problem]) -> Literal["ok", "overloaded", "degraded"]:
    """The status's one word for them."""
    if not problems:
        return "ok"
    return "overloaded" if set(problems) == {Problem.OVERLOADED} else "degraded"


class Readiness:
    """What any thread may ask at any time, from before the map is recovered until after it is stored."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._look: Callable[[], Mapping[Problem, str]] = lambda: {Problem.STARTING: "the map is being recovered"}

    def become(self, look: Callable[[], Mapping[Problem, str]]) -> None:
        """From now on ``look`` tells the problems, each with its cause in plain words."""
        with self._lock:
            self._look = look

    def end(self) -> None:
        """The service is shutting down."""
        self.become(lambda: {Problem.SHUTTING_DOWN: "the service is shutting down"})

    def problems(self) -> dict[Problem, str]:
        """What is wrong now, of which `is_ready` makes whether it is ready."""
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
) -> dict[Problem, str]:
    """The problems of a service that runs; ``turned`` is when the sequencer last began a turn, in monotonic s."""
    found: dict[Problem, str] = {}
    idle = time.monotonic() - turned
    if not alive:
        found[Problem.SEQUENCER_DEAD] = f"the sequencer ended: {failure}"
    elif idle > STALLED_SECONDS:
        why = f"the sequencer has taken nothing up for {idle:.0f} s: it hangs, or its disk does"
        found[Problem.SEQUENCER_STALLED] = why
    if not log_ok:
        found[Problem.LOG_NOT_WRITABLE] = f"the log can't be written: {log_error}"
    if not memory_ok:
        found[Problem.MEMORY_FULL] = "tiles can't leave memory; beyond map.memory_limit no new ones are taken"
    if not store_ok:
        found[Problem.SNAPSHOT_FAILED] = f"the store can't be written: {store_error}; the log holds all"
    if overloaded:
        found[Problem.OVERLOADED] = "more comes in than can be integrated; the oldest clouds are dropped and counted"
    return found


@dataclass
class Sources:
    """Where the pages have what they show; what is None is not there yet."""

    readiness: Readiness
    map: str = ""
    url: str | None = None
    status: Callable[[], MapStatus] | None = None
    metrics: Callable[[], bytes] | None = None
