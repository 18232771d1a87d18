"""The end of the service: one time limit for everything that it still waits for."""

import logging
import os
import threading
import time

logger = logging.getLogger(__name__)

LINKS_SECONDS = 2.0
"""How long links may take to close once everything is on the disk. A healthy one takes milliseconds. If the other end
stopped reading, Zenoh would wait ten seconds and more."""


class Ending:
    """Counts down ``seconds`` from `begin`, and at most `LINKS_SECONDS` from `kept`. At zero the process exits.

    Its exit code is 0 if `kept` was called by then, else 1.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._until: float | None = None
        self._kept = False

    def begin(self) -> None:
        """Start the countdown; later calls have no effect."""
        if self._until is None:
            self._until = time.monotonic() + self._seconds
            self._give_up_after(self._seconds)

    def left(self, share: float = 1.0) -> float:
        """Return the seconds that are left, or a share of them."""
        self.begin()
        assert self._until is not None  # noqa: S101 - `begin` set it
        return max(self._until - time.monotonic(), 0.0) * share

    def kept(self) -> None:
        """Note that everything is on the disk. Only links are left to wait for, and a stalled client may hold one."""
        self._kept = True
        self._give_up_after(min(self.left(), LINKS_SECONDS))

    def _give_up_after(self, seconds: float) -> None:
        last = threading.Timer(seconds, self._give_up)
        last.daemon = True
        last.start()

    def _give_up(self) -> None:
        if self._kept:
            logger.warning("closed the links of clients that stopped reading; everything is on disk")
            os._exit(0)
        logger.critical(
            "the service did not end within service.shutdown_timeout (%g s): anything not yet on the disk is lost",
            self._seconds,
        )
        os._exit(1)


class ShuttingDown(Exception):
    """The service ends before a request is done."""
