"""The end of the service: one time limit for all that still has to be waited for."""

import logging
import os
import threading
import time

log = logging.getLogger(__name__)

LINKS_SECONDS = 2.0
"""How long links may take to close once all is on the disk: a healthy one takes milliseconds, and Zenoh waits up to ten
seconds and more for one whose other end has stopped reading, to which nothing can be delivered."""


class Ending:
    """Counts down from `begin`, and from `kept` on at most `LINKS_SECONDS`; when nothing is left, the process ends,
    whatever it waits for: as one that failed, unless all was on the disk by then."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._until: float | None = None
        self._kept = False

    def begin(self) -> None:
        """The end has begun; later calls change nothing."""
        if self._until is None:
            self._until = time.monotonic() + self._seconds
            self._give_up_after(self._seconds)

    def left(self, share: float = 1.0) -> float:
        """Seconds that are left, or a share of them."""
        self.begin()
        assert self._until is not None  # noqa: S101 - begin() set it
        return max(self._until - time.monotonic(), 0.0) * share

    def kept(self) -> None:
        """All is on the disk: what is waited for from here on are links, and a client that stalls may hold its own."""
        self._kept = True
        self._give_up_after(min(self.left(), LINKS_SECONDS))

    def _give_up_after(self, seconds: float) -> None:
        last = threading.Timer(seconds, self._give_up)
        last.daemon = True
        last.start()

    def _give_up(self) -> None:
        if self._kept:
            log.warning("links of clients that stopped reading are cut; all is on the disk")
            os._exit(0)
        log.critical(
            "the service did not end within service.shutdown_timeout (%g s): what was not on the disk is lost",
            self._seconds,
        )
        os._exit(1)


class ShuttingDown(Exception):
    """The service ends before what was asked for is done."""
