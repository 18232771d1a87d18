"""The run's log files, one after another: appends to the newest, and goes on in the next."""

import contextlib
import math
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from roughmap_schemas import RunMetadata
from roughmap_schemas.kinds import INPUTS, Kind
from roughmap_service.journal.file import LogFile, OpenFile, file_name
from roughmap_service.journal.records import LogRecord

LOOK_SECONDS = 5.0
"""Shortest time between two looks at the disk's free space."""


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the run: the last input and record before it, and the epoch and sequence of the last event."""

    input: int
    record: int
    epoch: int
    sequence: int

    def after(self, record: LogRecord) -> "Place":
        """Return the place behind a record."""
        if record.kind in INPUTS:
            return Place(record.number, self.record + 1, self.epoch, self.sequence)
        if record.kind is Kind.EVENTS:
            return Place(self.input, self.record + 1, record.epoch, record.sequence)
        return self


class FileSequence:
    """Files of ``directory``, the first of which begins with ``metadata``. ``last_ns`` as for `LogFile`.

    Its methods belong to one thread and may raise OSError. After a failure of any but `leave`, call `leave`, then
    `begin_next`, and write again what came after the last `sync`. Properties may be read from any thread.
    """

    def __init__(
        self, directory: Path, metadata: RunMetadata, *, compression: str, open_file: OpenFile, last_ns: int
    ) -> None:
        self._directory = directory
        self._metadata = metadata
        self._compression = compression
        self._open_file = open_file
        self._first_index = metadata.index
        self._unbegun: Path | None = None  # a file we created whose beginning could not be written
        self._written = self._synced = Place(
            metadata.first_input - 1, metadata.first_record - 1, metadata.epoch, metadata.base_sequence
        )
        self._begun = self._written
        self._left = False
        self._file = self._open(metadata, last_ns)
        self._total = self._size = self._file.size
        self._free: int | None = None
        self._looked = -math.inf
        self._look_at_disk()

    @property
    def path(self) -> Path:
        """The present file."""
        return self._file.path

    @property
    def index(self) -> int:
        """Its index among the run's files, from 0."""
        return self._metadata.index

    @property
    def size(self) -> int:
        """Its bytes on the disk."""
        return self._size

    @property
    def total(self) -> int:
        """Bytes on the disk of all files of this start, but for their footers."""
        return self._total

    @property
    def free(self) -> int | None:
        """Bytes that were free on the disk some seconds ago; None if unknown."""
        return self._free

    @property
    def age(self) -> float:
        """Seconds since it was created."""
        return time.monotonic() - self._file.opened

    @property
    def durable_sequence(self) -> int:
        """The map's sequence after the last event on the disk."""
        return self._synced.sequence

    def write(self, record: LogRecord) -> None:
        """Append a record."""
        self._file.write(record)
        self._written = self._written.after(record)

    def flush(self) -> None:
        """Hand everything written to the operating system."""
        self._file.flush()

    def sync(self) -> None:
        """Bring everything written to the disk."""
        size = self._file.sync()
        self._total += size - self._size
        self._size, self._synced = size, self._written
        self._look_at_disk()

    def finish(self) -> None:
        """Give the present file its footer and close it."""
        self._file.close()

    def leave(self) -> None:
        """Close a present file that failed, truncated to what was synced; the next file begins there.

        A file that holds only its beginning is removed and the next takes its name: otherwise a disk that takes a
        beginning at every try, and nothing else, would fill with them. The first file of a start stays, since it
        records the epoch.
        """
        if not self._left:
            if self._file.closed or self.index == self._first_index or self._synced != self._begun:
                self._file.abandon(self._size)
            else:
                self._file.let_go()
                self._file.path.unlink(missing_ok=True)
                self._metadata = self._metadata.model_copy(update={"index": self.index - 1})
                self._total -= self._size
            self._left = True
        self._written = self._synced

    def leave_unfinished(self) -> None:
        """Close a present file whose footer failed, truncated to what was synced; the next start repairs it."""
        with contextlib.suppress(OSError):
            self._file.abandon(self._size)
        self._left = True

    def begin_next(self, digest: str) -> None:
        """Go on in a new file. ``digest`` is the map's digest at this place, "" where it is not known."""
        metadata = self._metadata.model_copy(
            update={
                "created_ns": time.time_ns(),
                "index": self.index + 1,
                "epoch": self._written.epoch,
                "first_input": self._written.input + 1,
                "first_record": self._written.record + 1,
                "base_sequence": self._written.sequence,
                "base_digest": digest,
            }
        )
        self._file = self._open(metadata, self._file.last_ns)
        self._metadata, self._begun, self._left = metadata, self._written, False
        self._size = self._file.size
        self._total += self._size

    def _look_at_disk(self) -> None:
        """Note how much is free, now and then: here, since other threads must not wait for a disk that hangs."""
        now = time.monotonic()
        if now - self._looked >= LOOK_SECONDS:
            self._looked = now
            try:
                self._free = shutil.disk_usage(self._directory).free
            except OSError:
                self._free = None

    def _open(self, metadata: RunMetadata, last_ns: int) -> LogFile:
        path = self._directory / file_name(metadata.run, metadata.index)
        if path == self._unbegun:
            path.unlink(missing_ok=True)
        try:
            return LogFile(path, metadata, self._compression, self._open_file, last_ns=last_ns)
        except FileExistsError:
            raise  # another file, not ours to delete
        except Exception:
            # A file without its beginning is not part of the run; the next try takes the same name.
            self._unbegun = path
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            raise
