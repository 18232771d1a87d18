"""Where tiles lie that are not in memory: in a file of their own, or still in the store that the map began with."""

import errno
import fcntl
import os
import stat
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import xxhash

from roughmap.arrays import I4, I8, Records
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.tiles.shelf import Shelf, runs_of
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_schemas.faults import ReportedError
from roughmap_service.store.map_db import DamagedStore, StoreError
from roughmap_service.store.stored_tiles import StoredTiles

ROW_BYTES = TILE_CELLS * CELL_DTYPE.itemsize
NOWHERE, STORED = -1, -2
"""What `_slice` says of a place that is free, and of one whose tile lies in the store."""

STEP = 1024
"""Places by which the tables grow."""


class SpillError(ReportedError):
    """A spill file that can't be used, or does not hold what was written; one line."""

    exit_code = 2


Write = Callable[[int, Sequence[memoryview], int], int]


class Spill(Shelf):
    """The map's shelf. A context manager: the file is made anew at the start and removed at the end.

    Each tile in the file has a slice of 256 KiB, of which only its known rows are written, one after the other: what
    is left over is a hole, which costs no disk. They are not compressed: that costs more time than it saves.

    Attributes:
        failure: what was found damaged by a reader, in one line; empty if nothing was.
        store_damaged: whether that was in the store.
    """

    def __init__(self, path: Path, limit: int, *, write: Write = os.pwritev) -> None:
        super().__init__()
        self.path = path
        self.failure = ""
        self.store_damaged = False
        self._most = limit // SLOT_BYTES
        self._pwritev = write
        self._stored: StoredTiles | None = None
        self._number = np.zeros(0, np.int32)  # of a place: which of the stored tiles it is
        self._slice = np.zeros(0, np.int32)
        self._rows = np.zeros(0, np.uint64)
        self._check = np.zeros(0, np.uint64)
        self._left: list[int] = []
        self._slices = 0
        self._file = _open_anew(path)

    @property
    def room(self) -> int:
        """How many tiles more the file may take."""
        return self._most - self._slices + len(self._left)

    def _grow(self, number: int = STEP) -> None:
        slices = np.append(self._slice, np.full(number, NOWHERE, np.int32))
        rows = np.append(self._rows, np.zeros(number, np.uint64))
        check = np.append(self._check, np.zeros(number, np.uint64))
        self._extend(number)
        self._slice, self._rows, self._check = slices, rows, check

    def allocate(self, number: int) -> I4:
        """Places with a slice of the file each; MemoryError, and nothing taken, beyond `room`."""
        if number > self.room:
            raise MemoryError(f"{self.path}: {number} tiles more, room for {self.room}")
        places = super().allocate(number)
        for place in places.tolist():
            if not self._left:
                self._left.append(self._slices)
                self._slices += 1
            self._slice[place] = self._left.pop()
        return places

    def adopt(self, stored: StoredTiles) -> I4:
        """Places for all tiles of a store, which stay there; before anything else lies here."""
        if self.used:
            raise ValueError("expected a spill file without tiles")
        if self._stored is not None:  # of a recovery that failed, and begins again
            self._stored.close()
        self._stored = stored
        number = len(stored.index.tx)
        self._grow(max(number - len(self._free), 0))  # at once: step by step, millions would take minutes
        places = super().allocate(number)
        self._slice[places] = STORED
        self._number = np.zeros(len(self.pins), np.int32)
        self._number[places] = np.arange(number)
        return places

    def _recycle(self, place: int) -> None:
        if self._slice[place] >= 0:
            self._left.append(int(self._slice[place]))
        self._slice[place] = NOWHERE
        super()._recycle(place)

    def outlived(self) -> I8:
        """The places of tiles that have changed since they were stored, and are still read as they were then."""
        return np.flatnonzero((self._slice == STORED) & ~self.live)

    def write(self, place: int, records: Records, rows: int) -> None:
        """See `Shelf.write`."""
        data = records.view(np.uint8).data
        parts = [data[start * ROW_BYTES : stop * ROW_BYTES] for start, stop in runs_of(rows)]
        if self._pwritev(self._file, parts, int(self._slice[place]) * SLOT_BYTES) < rows.bit_count() * ROW_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self._rows[place] = rows
        self._check[place] = _checksum(parts)

    def read(self, place: int, records: Records) -> None:
        """See `Shelf.read`. SpillError or StoreError, which is also remembered as `failure`."""
        try:
            if self._slice[place] == STORED:
                assert self._stored is not None  # noqa: S101 - that is where the place comes from
                self._stored.read(int(self._number[place]), records)
            else:
                self._read_file(place, records)
        except (SpillError, StoreError) as error:
            self.failure = str(error)
            self.store_damaged = isinstance(error, DamagedStore)
            raise

    def _read_file(self, place: int, records: Records) -> None:
        rows = int(self._rows[place])
        data = records.view(np.uint8).data
        parts = [data[start * ROW_BYTES : stop * ROW_BYTES] for start, stop in runs_of(rows)]
        try:
            read = os.preadv(self._file, parts, int(self._slice[place]) * SLOT_BYTES)
        except OSError as error:
            raise SpillError(f"{self.path}: {error.strerror}; start again, the log has all") from None
        if read < rows.bit_count() * ROW_BYTES or _checksum(parts) != int(self._check[place]):
            raise SpillError(f"{self.path}: a tile is not as it was written; start again, the log has all")

    def close(self) -> None:
        """Remove the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self.path.unlink(missing_ok=True)
        if self._stored is not None:
            self._stored.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _open_anew(path: Path) -> int:
    """A descriptor of the file, made anew, held against other processes. SpillError if it can't be had.

    What lies there is never written to: it may be somebody else's, who would read in it, or another name of a file.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            left = _held(path, 0)
            path.unlink()
            os.close(left)
        return _held(path, os.O_CREAT | os.O_EXCL)
    except BlockingIOError:
        raise SpillError(f"{path}: held by another service; give this one its own map.spill_path") from None
    except OSError as error:
        raise SpillError(f"{path}: {error.strerror}; map.spill_path names a file that can be written") from None


def _held(path: Path, flags: int) -> int:
    """The plain file, opened and locked."""
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | flags, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            raise SpillError(f"{path}: is no plain file; map.spill_path names one that may be emptied")
    except BaseException:
        os.close(file)
        raise
    return file


def _checksum(parts: Sequence[memoryview]) -> int:
    digest = xxhash.xxh3_64()
    for part in parts:
        digest.update(part)
    return digest.intdigest()
