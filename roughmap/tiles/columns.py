"""The columns in memory: places that belong to slots."""

import numpy as np

from roughmap.arrays import I4, Flags, Records
from roughmap.cell import COLUMN_DTYPE, TILE_CELLS
from roughmap.tiles.rows import COLUMN_ROW, based_rows, copy_rows
from roughmap.tiles.slabs import SLAB_PLACES, Slabs

COLUMN_BYTES = TILE_CELLS * TILE_CELLS * COLUMN_DTYPE.itemsize


class Columns:
    """Places of 256 KiB, each the column of one slot: zeroed when handed out, returned to the system when freed.

    Most of a column is zero: a row of 64 cells is one page, and pages are small ones, so that a column costs only the
    rows with a based cell. Only the writer calls these methods, under its lock; :meth:`records` of a pinned slot needs
    no lock.

    Attributes:
        address: (S,) uint64, the address of each slot's column, 0 if it has none.
    """

    def __init__(self) -> None:
        self._slabs = Slabs(COLUMN_BYTES)
        self._free: list[int] = []
        self._place = np.zeros(0, np.int32)  # of a slot, -1 if it has none
        self.address = np.zeros(0, np.uint64)

    @property
    def used(self) -> int:
        """Number of slots with a column."""
        return len(self._slabs.address) - len(self._free)

    def extend(self, first: int, number: int) -> None:
        """Add ``number`` slots without a column, from ``first`` on; MemoryError, and no change, if that fails."""
        place = np.append(self._place[:first], np.full(number, -1, np.int32))
        address = np.append(self.address[:first], np.zeros(number, np.uint64))
        self._place, self.address = place, address

    def of(self, slots: I4) -> Flags:
        """Return which of these slots have a column."""
        return self._place[slots] >= 0

    def take(self, slots: I4) -> None:
        """Give each of these slots, which have none, a zeroed column that takes no memory before it is written.

        MemoryError, and no change, if that is not possible.
        """
        while len(self._free) < len(slots):
            first = len(self._slabs.address)
            free = [*range(first + SLAB_PLACES - 1, first - 1, -1), *self._free]
            self._slabs.grow(first, huge_pages=False)
            self._free = free
        places = self._free[len(self._free) - len(slots) :]
        del self._free[len(self._free) - len(slots) :]
        self._place[slots] = places
        self.address[slots] = self._slabs.address[self._place[slots]]

    def drop(self, slots: I4) -> None:
        """Take back the columns of those of these slots that have one; nothing was written to them."""
        slots = slots[self.of(slots)]
        self._free += self._place[slots].tolist()
        self._place[slots] = -1
        self.address[slots] = 0

    def release(self, slot: int) -> None:
        """Take back a slot's column, if it has one."""
        place = int(self._place[slot])
        if place >= 0:
            self._slabs.give_back(place)
            self._free.append(place)
            self._place[slot] = -1
            self.address[slot] = 0

    def copy(self, source: int, target: int, known: int) -> None:
        """Copy a slot's column to another slot's, which is zeroed. ``known``: as for :meth:`rows`."""
        copy_rows(self.address[source], self.address[target], np.uint64(self.rows(source, known)), COLUMN_ROW)

    def rows(self, slot: int, known: int) -> int:
        """Return which rows of a slot's column hold a based cell: bit j for row j.

        ``known``: the slot's rows with a known cell; a based cell is in one of them.
        """
        return int(based_rows(self.address[slot], np.uint64(known))) if self._place[slot] >= 0 else 0

    def records(self, slot: int) -> Records | None:
        """Return a view of a slot's (4096,) COLUMN_DTYPE records, None if it has no column."""
        place = int(self._place[slot])
        return None if place < 0 else self._slabs.view(place, COLUMN_DTYPE, TILE_CELLS * TILE_CELLS)
