"""Tiles outside memory: in the spill file, or still in the store that the map began with."""

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

from roughmap.arrays import I4, I8
from roughmap.cell import TILE_CELLS
from roughmap.tiles.columns import COLUMN_BYTES
from roughmap.tiles.shelf import Shelf, runs_of
from roughmap.tiles.slots import SLOT_BYTES
from roughmap.tiles.state import TileState
from roughmap_schemas.faults import ReportedError
from roughmap_service.store.map_db import DamagedStore, StoreError
from roughmap_service.store.stored_tiles import StoredTiles

SLICE_BYTES = SLOT_BYTES + COLUMN_BYTES
"""Bytes of the file for a tile, with or without a column."""

NOWHERE, STORED = -1, -2
"""Values of `_slice` for a free place, and for a place whose tile is in the store."""

REMEDY = "restart the service: it rebuilds the map from the log"

STEP = 1024
"""The tables grow by this many places."""


class SpillError(ReportedError):
    """A spill file that can't be used or is damaged; one line."""

    exit_code = 2


Write = Callable[[int, Sequence[memoryview], int], int]


class Spill(Shelf):
    """The map's shelf, in a spill file of at most ``limit`` bytes. A context manager that creates and removes the file.

    Each tile has a slice of 592 KiB of the file. Only the rows that hold something are written, one after another; the
    rest of the slice is a hole, which takes no disk space. Rows are not compressed: that would cost more time than it
    saves.

    Attributes:
        failure: the damage that a read found, in one line; "" if there is none.
        store_damaged: whether that damage is in the store.
    """

    def __init__(self, path: Path, limit: int, *, write: Write = os.pwritev) -> None:
        super().__init__()
        self.path = path
        self.failure = ""
        self.store_damaged = False
        self._max_slices = limit // SLICE_BYTES
        self._pwritev = write
        self._stored: StoredTiles | None = None
        self._number = np.zeros(0, np.int32)  # of a place: its tile's number in the store's index
        self._slice = np.zeros(0, np.int32)
        self._known = np.zeros(0, np.uint64)
        self._based = np.zeros(0, np.uint64)
        self._check = np.zeros(0, np.uint64)
        self._free_slices: list[int] = []
        self._slices = 0
        self._file = _create_locked(path)

    @property
    def room(self) -> int:
        """How many more tiles the file may take."""
        return self._max_slices - self._slices + len(self._free_slices)

    def _grow(self, number: int = STEP) -> None:
        slices = np.append(self._slice, np.full(number, NOWHERE, np.int32))
        known = np.append(self._known, np.zeros(number, np.uint64))
        based = np.append(self._based, np.zeros(number, np.uint64))
        check = np.append(self._check, np.zeros(number, np.uint64))
        self._extend(number)
        self._slice, self._known, self._based, self._check = slices, known, based, check

    def allocate(self, number: int) -> I4:
        """Allocate places with a slice of the file each; MemoryError, and no change, beyond `room`."""
        if number > self.room:
            raise MemoryError(f"{self.path}: room for {self.room} more tiles, not for {number}")
        places = super().allocate(number)
        for place in places.tolist():
            if not self._free_slices:
                self._free_slices.append(self._slices)
                self._slices += 1
            self._slice[place] = self._free_slices.pop()
        return places

    def adopt(self, stored: StoredTiles) -> I4:
        """Allocate places for all tiles of a store, which stay in it; only before any other place is allocated."""
        if self.used:
            raise ValueError("expected a spill file without tiles")
        if self._stored is not None:  # from a recovery that failed and begins again
            self._stored.close()
        self._stored = stored
        number = len(stored.index.tx)
        self._grow(max(number - len(self._free), 0))  # in one step: millions of tiles in small steps would take minutes
        places = super().allocate(number)
        self._slice[places] = STORED
        self._number = np.zeros(len(self.pins), np.int32)
        self._number[places] = np.arange(number)
        return places

    def _recycle(self, place: int) -> None:
        if self._slice[place] >= 0:
            self._free_slices.append(int(self._slice[place]))
        self._slice[place] = NOWHERE
        super()._recycle(place)

    def outdated(self) -> I8:
        """Return the places in the store of tiles that have changed since, and that frozen maps may still read."""
        return np.flatnonzero((self._slice == STORED) & ~self.live)

    def write(self, place: int, state: TileState, known: int, based: int) -> None:
        """See `Shelf.write`."""
        parts = _rows_of(state, known, based)
        offset = int(self._slice[place]) * SLICE_BYTES
        if self._pwritev(self._file, parts, offset) < sum(part.nbytes for part in parts):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self._known[place], self._based[place] = known, based
        self._check[place] = _checksum(parts)

    def read(self, place: int, room: TileState) -> bool:
        """See `Shelf.read`. SpillError or StoreError, which is also remembered as `failure`."""
        try:
            if self._slice[place] == STORED:
                assert self._stored is not None  # noqa: S101 - `adopt` made the place
                return self._stored.read(int(self._number[place]), room)
            return self._read_file(place, room)
        except (SpillError, StoreError) as error:
            self.failure = str(error)
            self.store_damaged = isinstance(error, DamagedStore)
            raise

    def _read_file(self, place: int, room: TileState) -> bool:
        known, based = int(self._known[place]), int(self._based[place])
        parts = _rows_of(room, known, based)
        try:
            read = os.preadv(self._file, parts, int(self._slice[place]) * SLICE_BYTES)
        except OSError as error:
            raise SpillError(f"{self.path}: {error.strerror}; {REMEDY}") from None
        if read < sum(part.nbytes for part in parts) or _checksum(parts) != int(self._check[place]):
            raise SpillError(f"{self.path}: a tile is damaged; {REMEDY}")
        return bool(based)

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


def _create_locked(path: Path) -> int:
    """Create the file, lock it against other processes, and return its descriptor; SpillError if that fails.

    A file that is there already is removed, never written to: another user may have it open, or it may be a second name
    of another file.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            left = _open_locked(path, 0)
            path.unlink()
            os.close(left)
        return _open_locked(path, os.O_CREAT | os.O_EXCL)
    except BlockingIOError:
        raise SpillError(f"{path}: held by another service; give this one its own map.spill_path") from None
    except OSError as error:
        raise SpillError(f"{path}: {error.strerror}; set map.spill_path to a file that can be written") from None


def _open_locked(path: Path, flags: int) -> int:
    """Open and lock a plain file; return its descriptor."""
    file = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | flags, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            raise SpillError(f"{path}: not a plain file; set map.spill_path to a file that may be removed")
    except BaseException:
        os.close(file)
        raise
    return file


def _rows_of(state: TileState, known: int, based: int) -> list[memoryview]:
    """Return the bytes of the rows in use of a tile's arrays: cells, trust, column."""
    parts = []
    for array, rows in zip(state.arrays, (known, known, based), strict=False):
        data, size = array.view(np.uint8).data, TILE_CELLS * array.itemsize
        parts += [data[start * size : stop * size] for start, stop in runs_of(rows)]
    return parts


def _checksum(parts: Sequence[memoryview]) -> int:
    digest = xxhash.xxh3_64()
    for part in parts:
        digest.update(part)
    return digest.intdigest()
