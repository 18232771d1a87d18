"""Problems of ROS topics, told when they last: in log lines, and to those who ask."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Final, Self

from roughmap_service.host.log_lines import note

logger = logging.getLogger(__name__)

LOOK_S: Final = 2.0
"""How often is looked at what is wrong."""

TOLD_S: Final = 5.0
"""How long something must have been wrong before it is a problem: at a start, topics and transforms come one by one."""

CLOSING_S: Final = 2.0
"""Longest wait at the end for a look that is under way."""


class Told:
    """Problems that last, each logged when it begins and when it ends. A thread looks for them while it is entered."""

    def __init__(self, find: Callable[[], Mapping[str, str]], clock: Callable[[], float] = time.monotonic) -> None:
        self._find = find
        self._clock = clock
        self._since: dict[str, float] = {}
        self._told: dict[str, str] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-look", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join(CLOSING_S)

    def problems(self) -> dict[str, str]:
        """Return the problems that last, a sentence for each subject."""
        return self._told

    def look(self) -> None:
        """Find the problems, and log those that began or ended."""
        found, now = self._find(), self._clock()
        self._since = {subject: self._since.get(subject, now) for subject in found}
        lasting = {subject: text for subject, text in found.items() if now - self._since[subject] >= TOLD_S}
        for subject, text in lasting.items():
            if subject not in self._told:
                note(logger, logging.WARNING, "ros2_problem", text, subject=subject, reason=subject)
        for subject in self._told.keys() - lasting.keys():
            note(logger, logging.INFO, "ros2_problem_ended", f"{subject}: no longer", subject=subject, reason=subject)
        self._told = lasting

    def _run(self) -> None:
        while not self._closing.wait(LOOK_S):
            try:
                self.look()
            except Exception:  # later looks may go well
                if not self._closing.is_set():
                    logger.exception("cannot look for problems of ROS topics")
