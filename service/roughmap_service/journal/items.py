"""What is queued to the log's thread, and what that holds of memory."""

from collections.abc import Callable
from dataclasses import dataclass

from roughmap_service.journal.records import LogRecord

RECORD_OVERHEAD = 128
"""Bytes that a queued record costs beside its payload."""


@dataclass(frozen=True, slots=True, eq=False)
class Sync:
    """Asks for all before it to be on the disk; then ``done`` is called from the log's thread and must not block.

    Where ``failed`` is given, who asked does not wait for a log that can't be written: as soon as that is seen it is
    called instead, once, with the cause, from any thread. What was queued before stays queued all the same.
    """

    done: Callable[[], None]
    failed: Callable[[str], None] | None = None


@dataclass(frozen=True, slots=True)
class Rotate:
    """Ends the file. ``digest`` is the map's at this place of the log."""

    digest: str


Item = LogRecord | Sync | Rotate


def cost(item: Item) -> int:
    """Bytes that an item counts for, queued or not yet on the disk."""
    return RECORD_OVERHEAD + (len(item.payload) if isinstance(item, LogRecord) else 0)
