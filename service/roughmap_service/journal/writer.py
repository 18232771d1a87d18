"""The log's own thread: appends in order, makes durable in groups, and keeps what a full disk would not take."""

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
from roughmap_service.journal.file import LogFile, Mark, OpenFile, file_name, open_new
from roughmap_service.journal.items import Item, Rotate, Sync, cost
from roughmap_service.journal.records import LogRecord

log = logging.getLogger(__name__)

RETRY_SECONDS = 1.0
"""A log that can't be written is tried again so often (the design's)."""

SYNC_SECONDS = 1.0
"""The disk is asked to keep all at least so often: what came since is held in memory, should the disk fail."""


class LogWriter:
    """Appends the run to files of ``directory``, the first of which begins with ``metadata``; a context manager.

    ``last_ns`` is the log time of the run's last message so far: times rise, whatever the clock does between starts.

    `put` never blocks and never fails: who must not run ahead of the disk asks `wait_room` first. Whatever is not on
    the disk yet is kept, so that a file that failed can be left behind and its end written first to the next one.
    ``synced`` is told how many seconds each fsync took.
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
        self._directory = directory
        self._metadata = metadata
        self._compression = compression
        self._flush_interval = flush_interval
        self._queue_limit = queue_limit
        self._max_file_bytes = max_file_bytes
        self._max_file_age = max_file_age
        self._open_file = open_file
        self._on_sync = synced
        self._wake = threading.Condition()
        self._queue: deque[Item] = deque()
        self._held = 0  # bytes queued or not yet on the disk
        self._stop = False
        self._impatient: set[Sync] = set()  # those that are told if the log fails first
        self._rotating = 0  # ends of the file that are asked for and not done
        self._unbegun: Path | None = None  # a file of ours whose beginning could not be written
        self._todo: deque[Item] = deque()
        self._unsynced: list[Item] = []
        self._mark = self._synced = Mark(
            metadata.first_input - 1, metadata.first_record - 1, metadata.epoch, metadata.base_sequence
        )
        self._begun = self._mark  # where the present file begins
        self._first_index = metadata.index
        self._left = False  # whether the present file failed and was let go
        self._file = self._open(metadata, last_ns)
        self._length = self._file.size
        self._last_flush = self._last_sync = time.monotonic()
        self._asked: float | None = None  # since when the disk is busy with what it was last asked
        self._failed = ""  # what went wrong, until the log is written again
        self._hangs = ""
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @property
    def ok(self) -> bool:
        """Whether the log can be written, as far as is known."""
        return not self.error

    @property
    def error(self) -> str:
        """Why it can't be; "" if it can."""
        return self._failed or self._hangs

    @property
    def path(self) -> Path:
        """The file that is written to now."""
        return self._file.path

    @property
    def index(self) -> int:
        """That file's place among the run's, from 0."""
        return self._metadata.index

    @property
    def size(self) -> int:
        """Bytes of that file that are on the disk."""
        return self._length

    @property
    def held(self) -> int:
        """Bytes queued, or written and not yet on the disk."""
        return self._held

    @property
    def durable_sequence(self) -> int:
        """The map's sequence as of the last event on the disk."""
        return self._synced.sequence

    def put(self, item: Item) -> None:
        """Queue an item; it is written after all that was queued before it."""
        with self._wake:
            failed = item.failed if isinstance(item, Sync) else None
            error = self.error if failed else ""
            if not error:
                if isinstance(item, Sync) and failed:
                    self._impatient.add(item)
                self._queue.append(item)
                self._held += cost(item)
                self._rotating += isinstance(item, Rotate)
                self._wake.notify_all()
        if failed and error:
            failed(error)

    def put_output(self, record: LogRecord) -> bool:
        """Queue an output, which is no part of the run; False if it was dropped, to leave room for what is."""
        with self._wake:
            if not self.ok or self._held + cost(record) > self._queue_limit // 2:
                return False
            self._queue.append(record)
            self._held += cost(record)
            self._wake.notify_all()
            return True

    def wait_room(self, timeout: float) -> bool:
        """Wait at most ``timeout`` s for the queue to be below its limit and the log to be writable."""
        with self._wake:
            return self._wake.wait_for(lambda: self.ok and self._held < self._queue_limit, timeout)

    def wait_synced(self, timeout: float) -> bool:
        """Wait until all that was queued before this call is on the disk; False after ``timeout`` s."""
        done = threading.Event()
        self.put(Sync(done.set))
        return done.wait(timeout)

    def wants_rotation(self) -> bool:
        """The file has reached its size or its age, and nobody asked yet for its end."""
        age = time.monotonic() - self._file.opened
        with self._wake:  # what is held goes into this file, and may be much of it, since the disk syncs once a second
            due = self._length + self._held >= self._max_file_bytes or age >= self._max_file_age
            return due and self.ok and not self._rotating

    def look(self) -> None:
        """Look whether the disk still answers: if it hangs, the log counts as one that can't be written until it does.
        Call it now and then, since the log's own thread is what hangs."""
        with self._wake:
            asked = self._asked
            if asked is None or self.error or time.monotonic() < asked + HANG_SECONDS:
                return
            self._hangs = f"{self._file.path}: its disk has not answered for {HANG_SECONDS:g} s"
        self._tell_failure()

    def close(self, timeout: float = 5.0) -> bool:
        """Write what is queued, the footer, fsync; False if the disk did not take it within ``timeout`` s."""
        with self._wake:
            self._stop = True
            self._wake.notify_all()
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
            stopping = self._take()
            try:
                self._write()
                if stopping and not self._queue:
                    self._sync()
                    self._file.close()
                    return
            except Exception as error:  # noqa: BLE001 - whatever it was, what is not on the disk must not be lost
                if not self._start_over(error):
                    return

    def _take(self) -> bool:
        """Take up what is queued, after waiting for something, for the next flush to be due, or for the end."""
        self._answered(None)
        with self._wake:
            due = max(self._last_flush + self._flush_interval - time.monotonic(), 0.0) if self._unsynced else None
            self._wake.wait_for(lambda: self._stop or bool(self._queue), due)
            self._todo.extend(self._queue)
            self._queue.clear()
            return self._stop

    def _write(self) -> None:
        """Write what is taken up. At any failure ``_unsynced`` and ``_todo`` hold all that is not on the disk."""
        while self._todo:
            self._answered(time.monotonic())
            item = self._todo[0]
            if isinstance(item, Rotate):
                self._sync()
                self._file.close()
                self._open_next(item.digest)
                note(log, logging.INFO, "rotated", f"the log goes on in {self.path}", file=str(self.path))
                self._todo.popleft()
                self._release([item])
                continue
            self._unsynced.append(self._todo.popleft())
            if isinstance(item, LogRecord):
                self._file.write(item)
                self._mark = self._mark.after(item)
        now = time.monotonic()
        wanted = any(isinstance(item, Sync) for item in self._unsynced)
        if wanted or now - self._last_sync >= SYNC_SECONDS or self._held > self._queue_limit // 2:
            self._sync()
        elif now - self._last_flush >= self._flush_interval:
            self._answered(now)
            self._file.flush()
            self._last_flush = now

    def _sync(self) -> None:
        begun = time.monotonic()
        self._answered(begun)
        length = self._file.sync()
        self._last_flush = self._last_sync = time.monotonic()
        self._answered(self._last_sync)
        self._on_sync(self._last_sync - begun)
        self._synced = self._mark
        done, self._unsynced = self._unsynced, []
        self._release(done, length)
        for item in done:
            if isinstance(item, Sync) and self._still_waits(item):
                try:
                    item.done()
                except Exception:  # the asker's fault: neither the disk's, nor that of those who asked after it
                    log.exception("what was to follow on a sync of the log failed")

    def _still_waits(self, item: Sync) -> bool:
        with self._wake:
            waits = item.failed is None or item in self._impatient
            self._impatient.discard(item)
            return waits

    def _answered(self, asked: float | None) -> None:
        """The disk has done what it was asked; it is asked the next thing at ``asked``, if anything."""
        self._asked = asked
        if self._hangs:
            with self._wake:
                self._hangs = ""
                self._wake.notify_all()
            note(log, logging.WARNING, "recovered", f"the log's disk answers again: {self.path}", always=True)

    def _release(self, items: list[Item], length: int | None = None) -> None:
        with self._wake:
            self._length = self._length if length is None else length
            self._held -= sum(cost(item) for item in items)
            self._rotating -= sum(isinstance(item, Rotate) for item in items)
            self._wake.notify_all()

    def _start_over(self, error: Exception) -> bool:
        """Leave the failed file as it was last synced, and write what came since to a new one; False at the end."""
        self._fail(error)
        self._hangs = ""
        with self._wake:
            whole = self._stop and not (self._unsynced or self._todo or self._queue)
        if whole:
            return self._end_without_footer()
        self._tell_failure()
        while True:
            with self._wake:
                last = self._wake.wait_for(lambda: self._stop, RETRY_SECONDS)
            try:
                self._leave()
                self._mark = self._synced
                self._todo.extendleft(reversed(self._unsynced))
                self._unsynced.clear()
                end = self._todo[0] if self._todo else None
                self._open_next(end.digest if isinstance(end, Rotate) else "")
                if isinstance(end, Rotate):  # it failed there, and is done now
                    self._todo.popleft()
                    self._release([end])
                self._write()
                self._sync()
            except Exception as again:  # noqa: BLE001 - as above
                self._fail(again)
                if last:
                    with contextlib.suppress(OSError):
                        self._leave()
                    log.error("the log was given up (%s): its last %d records are lost", self.error, self._kept())
                    return False
                continue
            with self._wake:
                self._failed = ""
                self._wake.notify_all()
            text = f"the log can be written again: {self._file.path}"
            note(log, logging.WARNING, "recovered", text, always=True, file=str(self._file.path))
            return True

    def _end_without_footer(self) -> bool:
        """Leave the file as it was synced at the end, when all is in it: a start gives it its footer. False."""
        log.warning("%s; the log is whole but for this file's footer, which the next start makes", self.error)
        with contextlib.suppress(OSError):
            self._file.abandon(self._length)
        self._left, self._failed = True, ""
        return False

    def _leave(self) -> None:
        """Let go of the failed file, cut to what was synced.

        One that holds nothing but its beginning is removed, and the next takes its name: a disk that takes a beginning
        at every try and never the rest must not fill with them. The first file of a start stays: it tells the epoch.
        """
        if self._left:
            return
        if self._file.closed or self._metadata.index == self._first_index or self._synced != self._begun:
            self._file.abandon(self._length)
        else:
            self._file.let_go()
            self._file.path.unlink(missing_ok=True)
            self._metadata = self._metadata.model_copy(update={"index": self._metadata.index - 1})
        self._left = True

    def _kept(self) -> int:
        """Records that are not on the disk."""
        with self._wake:
            return sum(isinstance(item, LogRecord) for item in (*self._unsynced, *self._todo, *self._queue))

    def _tell_failure(self) -> None:
        text = f"the log can't be written ({self.error}); no cloud is decided until it can"
        note(log, logging.ERROR, "degraded", text, always=True, cause=self.error)
        with self._wake:
            told, self._impatient, error = self._impatient, set(), self.error
        for item in told:
            if item.failed is not None:
                item.failed(error)

    def _fail(self, error: Exception) -> None:
        told = error.strerror if isinstance(error, OSError) else None
        self._failed = f"{getattr(error, 'filename', None) or self._file.path}: {told or error or type(error).__name__}"

    def _open_next(self, digest: str) -> None:
        """Go on in a new file; ``digest`` "" where the map's at this place is not known."""
        metadata = self._metadata.model_copy(
            update={
                "created_ns": time.time_ns(),
                "index": self._metadata.index + 1,
                "epoch": self._mark.epoch,
                "first_input": self._mark.input + 1,
                "first_record": self._mark.record + 1,
                "base_sequence": self._mark.sequence,
                "base_digest": digest,
            }
        )
        self._file = self._open(metadata, self._file.last_ns)
        self._metadata, self._begun, self._left = metadata, self._mark, False
        self._length = self._file.size

    def _open(self, metadata: RunMetadata, last_ns: int = 0) -> LogFile:
        path = self._directory / file_name(metadata.run, metadata.index)
        if path == self._unbegun:
            path.unlink(missing_ok=True)
        try:
            return LogFile(path, metadata, self._compression, self._open_file, last_ns=last_ns)
        except FileExistsError:
            raise  # whatever it is, it is not ours to delete
        except Exception:
            # A file without its beginning is no file of the run; the next try takes the same name.
            self._unbegun = path
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            raise
