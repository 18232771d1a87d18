"""What can be put in the log's queue."""

from collections.abc import Callable
from dataclasses import dataclass

from roughmap_service.journal.records import LogRecord

RECORD_OVERHEAD = 128
"""Bytes of memory that a queued record takes beside its payload."""


@dataclass(frozen=True, slots=True, eq=False)
class Sync:
    """A request to bring everything queued before it to the disk.

    The log's thread then calls ``done``, which must not block. With ``failed``, the request does not wait for a log
    that can't be written: ``failed`` is called instead, once, with the cause, from any thread. What was queued before
    the request stays queued in either case.
    """

    done: Callable[[], None]
    failed: Callable[[str], None] | None = None


@dataclass(frozen=True, slots=True)
class Rotate:
    """A request to go on in a new file. ``digest`` is the map's digest at this place of the log."""

    digest: str


Item = LogRecord | Sync | Rotate


def cost(item: Item) -> int:
    """Return the bytes of memory that an item takes until it is on the disk."""
    return RECORD_OVERHEAD + (len(item.payload) if isinstance(item, LogRecord) else 0)
