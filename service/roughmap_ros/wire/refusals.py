"""Messages that were refused, counted by topic and reason."""

import threading
from typing import Final

MAX_REASONS: Final = 64
"""Reasons that are told apart; those of later ones count as others."""

LARGER: Final = "larger than"
"""How the reason begins if a message is too large."""


def larger_than(limit: int) -> str:
    """Return the reason for refusing a message of more bytes than the limit."""
    return f"{LARGER} {limit} bytes (input.max_message)"


class Refusals:
    """Counts of refused messages. Any thread may use it."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()

    def count(self, topic: str, reason: str) -> None:
        """Count a message."""
        with self._lock:
            known = (topic, reason) in self._counts
            key = (topic, reason) if known or len(self._counts) < MAX_REASONS else (topic[:256], "other reasons")
            self._counts[key] = self._counts.get(key, 0) + 1

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """Counts by topic and reason."""
        with self._lock:
            return dict(self._counts)
