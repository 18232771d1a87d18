"""Robots' processes, started and ended; whatever was not ended is killed."""

import json
import subprocess
from types import TracebackType
from typing import Self

from feeder import Feed, command

END_S = 30.0
"""A robot that was told to end sends two messages more."""


class Robot:
    """A `feeder.py` at work; a context manager."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.process = subprocess.Popen(command(feed), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def end(self) -> dict[str, int]:
        """Have it end; the numbers of clouds and poses that it sent, and the second at which it may go on."""
        out, _ = self.process.communicate(timeout=END_S)
        if self.process.returncode:
            raise RuntimeError(f"robot {self.feed.robot} failed")
        sent: dict[str, int] = json.loads(out)
        return sent

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
