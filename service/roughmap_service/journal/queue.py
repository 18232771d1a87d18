"""The queue between the threads that log and the log's own thread."""

import threading
from collections import deque
from collections.abc import Iterable

from roughmap_service.journal.items import Item, Rotate, Sync, cost
from roughmap_service.journal.records import LogRecord

PROMPT_BYTES = 64 * 1024
"""Queued bytes that the log's thread takes at once. Fewer wait for its next flush: waking costs more than they do."""


class LogQueue:
    """Items in order, the memory they take until they are on the disk, and why the log can't be written, if it can't.

    ``limit`` is in bytes. An item counts from `put` until `release`: the log's thread keeps what it took until the disk
    has it. Any thread may call any method.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._held = 0
        self._queued = 0
        self._prompt = False
        self._idle = True
        self._rotations = 0
        self._impatient: set[Sync] = set()
        self._error = ""
        self._ending = False

    @property
    def error(self) -> str:
        """Why the log can't be written; "" if it can."""
        return self._error

    @property
    def ok(self) -> bool:
        """Whether the log can be written."""
        return not self._error

    @property
    def held(self) -> int:
        """Bytes put and not yet released."""
        return self._held

    @property
    def over_half(self) -> bool:
        """Whether more than half of the limit is held."""
        return self._held > self._limit // 2

    @property
    def rotating(self) -> bool:
        """Whether a `Rotate` was put and not yet released."""
        return self._rotations > 0

    @property
    def ending(self) -> bool:
        """Whether `end` was called."""
        return self._ending

    @property
    def empty(self) -> bool:
        """Whether everything put was taken."""
        return not self._items

    def put(self, item: Item) -> None:
        """Append an item; never blocks. A `Sync` with ``failed`` is refused at once while the log can't be written."""
        with self._changed:
            failed = item.failed if isinstance(item, Sync) else None
            error = self._error if failed else ""
            if not error:
                if isinstance(item, Sync) and failed:
                    self._impatient.add(item)
                self._append(item)
        if failed and error:
            failed(error)

    def put_output(self, record: LogRecord) -> bool:
        """Append a record that is not part of the run; return False if it was dropped: half of the limit is the run's.

        It is dropped too while the log can't be written.
        """
        with self._changed:
            if self._error or self._held + cost(record) > self._limit // 2:
                return False
            self._append(record)
            return True

    def wait_room(self, timeout: float) -> bool:
        """Wait at most ``timeout`` s until less than the limit is held and the log can be written."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._error and self._held < self._limit, timeout)

    def end(self) -> None:
        """Tell the log's thread to end once everything is written."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()

    def wait_end(self, timeout: float) -> bool:
        """Wait at most ``timeout`` s for `end`; return whether it was called."""
        with self._changed:
            return self._changed.wait_for(lambda: self._ending, timeout)

    def take(self, timeout: float | None) -> tuple[list[Item], bool]:
        """Return all items, and whether to end. Wait for `end`, or without ``timeout`` for an item.

        With one, in s, wait at most so long for a `Sync`, a `Rotate` or `PROMPT_BYTES` of records.
        """
        with self._changed:
            self._idle = timeout is None
            self._changed.wait_for(lambda: self._ending or self._prompt or (self._idle and bool(self._items)), timeout)
            items = list(self._items)
            self._items.clear()
            self._queued, self._prompt = 0, False
            return items, self._ending

    def release(self, items: Iterable[Item]) -> None:
        """Stop counting items that are done."""
        with self._changed:
            for item in items:
                self._held -= cost(item)
                self._rotations -= isinstance(item, Rotate)
            self._changed.notify_all()

    def claim(self, sync: Sync) -> bool:
        """Return whether ``sync.done`` is due: ``sync.failed`` was not called, and will not be after this."""
        with self._changed:
            due = sync.failed is None or sync in self._impatient
            self._impatient.discard(sync)
            return due

    def set_error(self, error: str) -> None:
        """Set why the log can't be written; "" when it can again."""
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def refuse_impatient(self) -> None:
        """Call ``failed`` of every `Sync` that does not wait for a log that can't be written."""
        with self._changed:
            refused, self._impatient, error = self._impatient, set(), self._error
        for sync in refused:
            if sync.failed is not None:
                sync.failed(error)

    def count_records(self) -> int:
        """Return how many records are queued and not yet taken."""
        with self._changed:
            return sum(isinstance(item, LogRecord) for item in self._items)

    def _append(self, item: Item) -> None:
        self._items.append(item)
        size = cost(item)
        self._held += size
        self._queued += size
        self._rotations += isinstance(item, Rotate)
        self._prompt |= self._queued >= PROMPT_BYTES or not isinstance(item, LogRecord)
        if self._prompt or self._idle:
            self._changed.notify_all()
