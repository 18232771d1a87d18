"""Disks for the log and the spill file that fail, fill up or hang."""

import errno
import io
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from net import WAIT_S

F = TypeVar("F", bound=io.FileIO)


class FailingDisk:
    """Counts its operations and fails at ``faults``: ``(what, n)`` is the n-th "open", "write" or "fsync".

    ``failed`` is set by the first failure.
    """

    def __init__(self, *faults: tuple[str, int]) -> None:
        self.faults = set(faults)
        self.counts = {"open": 0, "write": 0, "fsync": 0}
        self.works = self.broken = False
        """``works``: nothing fails any more. ``broken``: everything fails."""
        self.failed = threading.Event()

    def does(self, what: str) -> None:
        """Count an operation, or fail."""
        if self.works:
            return
        self.counts[what] += 1
        if self.broken or (what, self.counts[what]) in self.faults:
            self.failed.set()
            raise OSError(errno.ENOSPC, f"no room ({what} {self.counts[what]})")

    def open(self, path: Path) -> Any:
        """Open a new file on this disk."""
        raw = FailingFile(path, "xb")
        raw.disk = self
        try:
            self.does("open")
        except OSError:
            raw.close()  # the name is there, as after a failure to write the beginning
            raise
        return io.BufferedWriter(raw)


class FailingFile(io.FileIO):
    disk: FailingDisk

    def write(self, data: Any) -> int:
        try:
            self.disk.does("write")
        except OSError:
            super().write(bytes(data)[: len(data) // 2])  # a full disk takes a part
            raise
        return super().write(data)

    def fileno(self) -> int:
        self.disk.does("fsync")  # which is what the number is asked for
        return super().fileno()


class StuckFile(io.FileIO):
    """A file whose writes hang until ``free`` is set. If it is ``broken`` by then, the write that hung fails."""

    def __init__(self, path: Path, mode: str) -> None:
        super().__init__(path, mode)
        self.free, self.asked, self.broken = threading.Event(), threading.Event(), False
        self.free.set()

    def write(self, data: Any) -> int:
        if not self.free.is_set():
            self.asked.set()
            assert self.free.wait(WAIT_S)
            if self.broken:
                raise OSError(errno.EIO, "Input/output error", str(self.name))
        return super().write(data)


class FullFile(io.FileIO):
    """A file on a disk that is full past ``limit`` bytes."""

    limit = 1 << 40

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.limit:
            raise OSError(errno.ENOSPC, "No space left on device", str(self.name))
        return super().write(data)


class DiskOf(Generic[F]):
    """Opens files of one kind for the log, and keeps them: ``DiskOf(StuckFile)``."""

    def __init__(self, make: Callable[[Path, str], F]) -> None:
        self._make = make
        self.files: list[F] = []

    def open(self, path: Path) -> Any:
        self.files.append(self._make(path, "xb"))
        return io.BufferedWriter(self.files[-1])


class SpillDisk:
    """A disk that takes ``left`` more writes of the spill file, and then is full."""

    def __init__(self) -> None:
        self.left = 10**9

    def write(self, file: int, parts: Sequence[memoryview], offset: int) -> int:
        if self.left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.left -= 1
        return os.pwritev(file, parts, offset)
