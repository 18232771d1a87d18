"""The log's thread: writes in order, syncs in groups, and keeps what a failing disk did not take."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from roughmap_schemas import RunMetadata
from roughmap_service.host.disk import HANG_SECONDS
from roughmap_service.host.log_lines import note
from roughmap_service.journal.file import OpenFile, open_new
from roughmap_service.journal.file_sequence import FileSequence
from roughmap_service.journal.items import Item, Rotate, Sync
from roughmap_service.journal.queue import LogQueue
from roughmap_service.journal.records import LogRecord

logger = logging.getLogger(__name__)

RETRY_SECONDS = 1.0
"""Pause between tries to write a log that can't be written (given by the design)."""

SYNC_SECONDS = 1.0
"""The longest time between two syncs. What came since the last one is kept in memory, in case the disk fails."""


class LogWriter:
    """Logs the run to files of ``directory``, the first of which begins with ``metadata``; a context manager.

    `put` never blocks and never fails; a caller that must not run ahead of the disk calls `wait_room` first. Everything
    is kept in memory until it is on the disk, so that a file that failed can be left and the next one can begin with
    what the failed one lacks.

    ``last_ns``, kept as ``begun_ns``, is the log time of the run's last message so far: log times rise, whatever the
    clock does between two starts. ``synced`` is called with the seconds that each fsync took. ``queue_limit`` and
    ``max_file_bytes`` are in bytes, ``flush_interval`` and ``max_file_age`` in seconds.
    """

    def __init__(
        self,
        directory: Path,
        metadata: RunMetadata,
        *,
        compression: str = "none",
        flush_interval: float = 0.2,
        queue_limit: int = 128 << 20,
        max_file_bytes: int = 1 << 30,
        max_file_age: float = 3600.0,
        open_file: OpenFile = open_new,
        last_ns: int = 0,
        synced: Callable[[float], None] = lambda _seconds: None,
    ) -> None:
        self._flush_interval = flush_interval
        self._max_file_bytes = max_file_bytes
        self._max_file_age = max_file_age
        self._on_sync = synced
        self.begun_ns = last_ns
        self._queue = LogQueue(queue_limit)
        self._files = FileSequence(directory, metadata, compression=compression, open_file=open_file, last_ns=last_ns)
        self._todo: deque[Item] = deque()  # taken from the queue and not yet written
        self._unsynced: list[Item] = []  # written since the last sync
        self._sync_asked = False  # by one of these
        self._last_flush = self._last_sync = time.monotonic()
        self._disk = threading.Lock()  # guards the next two
        self._asked: float | None = None  # when the disk was given what it is busy with
        self._hangs = False
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @property
    def ok(self) -> bool:
        """Whether the log can be written, as far as is known."""
        return self._queue.ok

    @property
    def error(self) -> str:
        """Why it can't be; "" if it can."""
        return self._queue.error

    @property
    def path(self) -> Path:
        """The present file."""
        return self._files.path

    @property
    def index(self) -> int:
        """The present file's index among the run's files, from 0."""
        return self._files.index

    @property
    def size(self) -> int:
        """Bytes of the present file on the disk."""
        return self._files.size

    @property
    def total(self) -> int:
        """Bytes on the disk of all files of this start."""
        return self._files.total

    @property
    def free(self) -> int | None:
        """Bytes that were free on the disk some seconds ago; None if unknown."""
        return self._files.free

    @property
    def held(self) -> int:
        """Bytes queued, or written and not yet on the disk."""
        return self._queue.held

    @property
    def durable_sequence(self) -> int:
        """The map's sequence after the last event on the disk."""
        return self._files.durable_sequence

    def put(self, item: Item) -> None:
        """Queue an item; it is written after everything queued before it."""
        self._queue.put(item)

    def put_output(self, record: LogRecord) -> bool:
        """Queue an output, which is not part of the run; return False if it was dropped to leave room for the run."""
        return self._queue.put_output(record)

    def wait_room(self, timeout: float) -> bool:
        """Wait at most ``timeout`` s for the queue to be below its limit and the log to be writable."""
        return self._queue.wait_room(timeout)

    def wait_synced(self, timeout: float) -> bool:
        """Wait until everything queued before this call is on the disk; return False after ``timeout`` s."""
        done = threading.Event()
        self.put(Sync(done.set))
        return done.wait(timeout)

    def wants_rotation(self) -> bool:
        """Return whether the present file has reached its size or age, and no `Rotate` is queued."""
        if self._queue.rotating or not self.ok:  # first: after a rotation the size and age below are the new file's
            return False
        # What is held goes into this file too, and may be much of it, since the disk syncs once a second.
        full = self._files.size + self._queue.held >= self._max_file_bytes
        return full or self._files.age >= self._max_file_age

    def look(self) -> None:
        """Check whether the disk still answers. While it hangs, the log counts as one that can't be written.

        Call this regularly from another thread: the log's own is the one that hangs.
        """
        with self._disk:
            if self._asked is None or not self.ok or time.monotonic() < self._asked + HANG_SECONDS:
                return
            self._hangs = True
            self._queue.set_error(f"{self.path}: its disk has not answered for {HANG_SECONDS:g} s")
        self._report_failure()

    def close(self, timeout: float = 5.0) -> bool:
        """Write what is queued and the footer, and sync; return False if that is not done within ``timeout`` s."""
        self._queue.end()
        self._thread.join(timeout)
        return not self._thread.is_alive() and self.ok

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        while True:
            ending = self._take()
            try:
                self._write()
                if ending and self._queue.empty:
                    self._sync()
                    self._files.finish()
                    return
            except Exception as error:  # noqa: BLE001 - whatever the cause, what is not on the disk must not be lost
                if not self._start_over(error):
                    return

    def _take(self) -> bool:
        """Wait for items, the next flush or the end; take all items. Return whether this is the end."""
        self._busy_since(None)
        due = max(self._last_flush + self._flush_interval - time.monotonic(), 0.0) if self._unsynced else None
        items, ending = self._queue.take(due)
        self._todo.extend(items)
        return ending

    def _write(self) -> None:
        """Write what was taken. If this fails, ``_unsynced`` and ``_todo`` hold everything that is not on the disk."""
        while self._todo:
            self._busy_since(time.monotonic())
            item = self._todo[0]
            if isinstance(item, Rotate):
                self._rotate(item)
                continue
            self._unsynced.append(self._todo.popleft())
            if isinstance(item, LogRecord):
                self._files.write(item)
            else:
                self._sync_asked = True
        now = time.monotonic()
        if self._sync_asked or now - self._last_sync >= SYNC_SECONDS or self._queue.over_half:
            self._sync()
        elif now - self._last_flush >= self._flush_interval:
            self._busy_since(now)
            self._files.flush()
            self._last_flush = now

    def _rotate(self, item: Rotate) -> None:
        self._sync()
        self._files.finish()
        self._files.begin_next(item.digest)
        note(logger, logging.INFO, "rotated", f"the log goes on in {self.path}", file=str(self.path))
        self._todo.popleft()
        self._queue.release([item])

    def _sync(self) -> None:
        begun = time.monotonic()
        self._busy_since(begun)
        self._files.sync()
        done, self._unsynced, self._sync_asked = self._unsynced, [], False
        self._queue.release(done)
        self._last_flush = self._last_sync = time.monotonic()
        self._busy_since(self._last_sync)
        with self._disk:  # before anyone learns what is on the disk: the log can be written again
            if not self.ok:
                self._queue.set_error("")
        seconds = self._last_sync - begun
        _follow(lambda: self._on_sync(seconds))
        for item in done:
            if isinstance(item, Sync) and self._queue.claim(item):
                _follow(item.done)

    def _busy_since(self, asked: float | None) -> None:
        """Note that the disk has answered, and when it was asked the next thing (None: nothing, it is idle)."""
        with self._disk:
            self._asked = asked
            hung, self._hangs = self._hangs, False
            if hung:
                self._queue.set_error("")
        if hung:
            note(logger, logging.WARNING, "recovered", f"the log's disk answers again: {self.path}", always=True)

    def _start_over(self, error: Exception) -> bool:
        """Leave the failed file as last synced, and write what came since to a new one; return False at the end."""
        self._fail(error)
        if self._queue.ending and self._queue.empty and not (self._unsynced or self._todo):
            self._end_without_footer()
            return False
        self._report_failure()
        while True:
            last = self._queue.wait_end(RETRY_SECONDS)
            try:
                self._go_on()
            except Exception as again:  # noqa: BLE001 - as in `_run`
                self._fail(again)
                if last:
                    with contextlib.suppress(OSError):
                        self._files.leave()
                    logger.error("the log was given up (%s): its last %d records are lost", self.error, self._kept())
                    return False
                continue
            text = f"the log can be written again: {self.path}"
            note(logger, logging.WARNING, "recovered", text, always=True, file=str(self.path))
            return True

    def _go_on(self) -> None:
        """Go on in a new file, which begins with what the failed one lacks."""
        self._files.leave()
        self._todo.extendleft(reversed(self._unsynced))
        self._unsynced.clear()
        first = self._todo[0] if self._todo else None
        self._files.begin_next(first.digest if isinstance(first, Rotate) else "")
        if isinstance(first, Rotate):  # the failure came in it, and the new file completes it
            self._todo.popleft()
            self._queue.release([first])
        self._write()
        self._sync()

    def _end_without_footer(self) -> None:
        """End with all records on the disk; the next start gives the file its footer."""
        logger.warning("%s; the log is complete except for this file's footer, which the next start writes", self.error)
        self._files.leave_unfinished()
        self._queue.set_error("")

    def _fail(self, error: Exception) -> None:
        cause = error.strerror if isinstance(error, OSError) else None
        file = getattr(error, "filename", None) or self.path
        with self._disk:
            self._hangs = False
            self._queue.set_error(f"{file}: {cause or error or type(error).__name__}")

    def _report_failure(self) -> None:
        text = f"the log can't be written ({self.error}); no cloud is decided until it can"
        note(logger, logging.ERROR, "degraded", text, always=True, cause=self.error)
        self._queue.refuse_impatient()

    def _kept(self) -> int:
        """Return how many records are not on the disk."""
        own = sum(isinstance(item, LogRecord) for item in (*self._unsynced, *self._todo))
        return own + self._queue.count_records()


def _follow(action: Callable[[], None]) -> None:
    """Do what follows a sync. A bug in it must not look like a failing disk."""
    try:
        action()
    except Exception:
        logger.exception("an action that follows a sync of the log failed")
