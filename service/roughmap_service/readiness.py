"""Whether the service takes in and answers, and what stands in the way if not."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from roughmap_schemas.messages import MapStatus

STALLED_SECONDS = 10.0
"""The sequencer turns twice a second even when idle, and for as long as one scan takes when busy: if it has not for so
long, it hangs, or its disk does."""


class Problem(StrEnum):
    """Why the service is not ready."""

    STARTING = "starting"
    SHUTTING_DOWN = "shutting_down"
    SEQUENCER_DEAD = "sequencer_dead"
    SEQUENCER_STALLED = "sequencer_stalled"
    LOG_NOT_WRITABLE = "log_not_writable"
    MEMORY_FULL = "memory_full"
    OVERLOADED = "overloaded"


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
        """What stands in the way now; empty: ready."""
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
    overloaded: bool,
) -> dict[Problem, str]:
    """The problems of a service that runs; ``turned`` is when the sequencer last began a turn, in monotonic s."""
    found: dict[Problem, str] = {}
    idle = time.monotonic() - turned
    if not alive:
        found[Problem.SEQUENCER_DEAD] = f"the sequencer ended: {failure}"
    elif idle > STALLED_SECONDS:
        found[Problem.SEQUENCER_STALLED] = f"the sequencer has taken nothing up for {idle:.0f} s"
    if not log_ok:
        found[Problem.LOG_NOT_WRITABLE] = f"the log can't be written: {log_error}"
    if not memory_ok:
        found[Problem.MEMORY_FULL] = "tiles can't leave memory; beyond map.memory_limit no new ones are taken"
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
