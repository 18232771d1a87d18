"""Tiles in memory: slots of 4096 cells with their trust, which kernels access by address."""

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I4, U8, Flags, Records, Scalar
from roughmap.cell import CELL_DTYPE, TILE_CELLS, TRUST_DTYPE
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel
from roughmap.tiles.columns import COLUMN_BYTES, Columns
from roughmap.tiles.places import PlacePool
from roughmap.tiles.rows import CELL_ROW, TRUST_ROW, copy_rows, known_rows
from roughmap.tiles.slabs import SLAB_PLACES, Slabs
from roughmap.tiles.state import TileState

SLOT_CELLS = TILE_CELLS * TILE_CELLS
TRUST_OFFSET = SLOT_CELLS * CELL_DTYPE.itemsize
"""Bytes from the start of a slot to its trust."""

SLOT_BYTES = TRUST_OFFSET + SLOT_CELLS * TRUST_DTYPE.itemsize
DENSE_ROWS = 48
"""A tile with at least this many known rows costs little more if all of its memory is allocated."""

KEPT_SLOTS = 96
"""Free dense slots that keep their memory, 32 MiB. While a reader holds tiles, each scan copies the tiles that it
changes, and page faults would cost more than the copies."""

CELL_WORDS = CELL_DTYPE.itemsize // 8
"""Eight-byte words of a cell: word 0 is count | updated << 32, words 1 to 7 are the floats in CELL_DTYPE's order."""


@inline
def floats(address: Scalar) -> F8:
    """Return the cells at ``address`` as 8 * 4096 float64 words. Every eighth word, from word 0 on, is not a float."""
    return carray(pointer(address, np.float64(0.0)), (SLOT_CELLS * CELL_WORDS,))


@inline
def words(address: Scalar) -> U8:
    """Return the cells at ``address`` as 8 * 4096 uint64 words."""
    return carray(pointer(address, np.uint64(0)), (SLOT_CELLS * CELL_WORDS,))


@kernel
def _clear(address: Scalar) -> None:
    """Set a slot to zero."""
    slot = carray(pointer(address, np.uint64(0)), (SLOT_BYTES // 8,))
    for n in range(SLOT_BYTES // 8):
        slot[n] = 0


class SlotPool(PlacePool):
    """Slots of 336 KiB in memory, cells and then their trust, some with a column: zeroed when handed out.

    One row of 64 cells is one page, so that a partly known tile costs only the rows that were written. Dense slots, for
    tiles that are mostly known or soon will be, lie in slabs of huge pages, because a page fault costs more than the
    update of a hundred cells. A slot's column is copied, pinned and freed with it. :meth:`state` and :meth:`records` of
    pinned slots need no lock.

    Attributes:
        address: (S,) uint64, the address of each slot.
        dense: (S,) bool, whether it is dense.
    """

    def __init__(self) -> None:
        super().__init__()
        self._slabs = Slabs(SLOT_BYTES)
        self._columns = Columns()
        self._free_dense: list[int] = []
        self._written: set[int] = set()  # free dense slots that kept their memory and its content
        self.dense = np.zeros(0, np.bool_)

    @property
    def address(self) -> U8:
        """Address of each slot."""
        return self._slabs.address

    @property
    def column_address(self) -> U8:
        """Address of each slot's column, 0 for a slot without one."""
        return self._columns.address

    @property
    def used(self) -> int:
        """Number of slots that are not free."""
        return super().used - len(self._free_dense)

    @property
    def nbytes(self) -> int:
        """Bytes of the slots that are not free and of their columns, each counted whole."""
        return self.used * SLOT_BYTES + self._columns.used * COLUMN_BYTES

    def _map(self, *, dense: bool) -> None:
        """Add slots, which are the last of `_free`; MemoryError if that is not possible."""
        first = len(self.pins)  # what an earlier MemoryError left beyond that is cut off
        self.dense = np.append(self.dense[:first], np.full(SLAB_PLACES, dense))
        self._columns.extend(first, SLAB_PLACES)
        self._slabs.grow(first, huge_pages=dense)
        self._extend(SLAB_PLACES)

    def _grow(self) -> None:
        self._map(dense=False)  # with huge pages, one known row would cost as much as six tiles

    def _grow_dense(self) -> None:
        self._map(dense=True)
        self._free_dense += self._free[-SLAB_PLACES:]
        del self._free[-SLAB_PLACES:]

    def allocate(self, number: int, dense: Flags | None = None) -> I4:
        """Return ``number`` zeroed slots; ``dense`` (number,) marks those for tiles that will be mostly known."""
        if dense is None or not dense.any():
            return super().allocate(number)
        wanted = int(np.count_nonzero(dense))
        while len(self._free_dense) < wanted:
            self._grow_dense()
        slots = np.empty(number, np.int32)
        slots[~dense] = super().allocate(number - wanted)
        slots[dense] = [self._free_dense.pop() for _ in range(wanted)]
        self.live[slots] = True
        for slot in self._written.intersection(slots[dense].tolist()):
            self._written.remove(slot)
            _clear(self.address[slot])
        return slots

    def take_columns(self, slots: I4) -> I4:
        """Give each of these slots that has no column a zeroed one, and return these slots.

        A column that stays unwritten takes no memory. MemoryError, and no change, if there is no room.
        """
        taken = slots[~self._columns.of(slots)]
        self._columns.take(taken)
        return taken

    def drop_columns(self, slots: I4) -> None:
        """Take back those columns of these slots that there are; nothing may have been written to them."""
        self._columns.drop(slots)

    def duplicate(self, slots: I4) -> I4:
        """Return copies of slots and their columns, in new slots; MemoryError, and no change, if there is no room."""
        rows = [self.known_rows(slot) for slot in slots.tolist()]
        dense = self.dense[slots] | (np.array([known.bit_count() for known in rows]) >= DENSE_ROWS)
        copies = self.allocate(len(slots), dense)
        try:
            self._columns.take(copies[self._columns.of(slots)])
        except MemoryError:
            self.release(copies)
            raise
        for source, target, known in zip(slots.tolist(), copies.tolist(), rows, strict=True):
            copy_rows(self.address[source], self.address[target], np.uint64(known), CELL_ROW)
            trust = np.uint64(TRUST_OFFSET)
            copy_rows(self.address[source] + trust, self.address[target] + trust, np.uint64(known), TRUST_ROW)
            self._columns.copy(source, target, known)
        return copies

    def _recycle(self, place: int) -> None:
        self._columns.release(place)
        if self.dense[place] and len(self._written) < KEPT_SLOTS:
            self._written.add(place)
        else:
            self._slabs.give_back(place)
        if self.dense[place]:
            self._free_dense.append(place)
        else:
            self._free.append(place)

    def trim(self) -> None:
        """Return the memory of all free slots, because memory is short."""
        while self._written:
            self._slabs.give_back(self._written.pop())

    def writable(self, slot: int) -> TileState:
        """Return views of the slot's arrays."""
        cells = self._slabs.view(slot, CELL_DTYPE, SLOT_CELLS)
        trust = self._slabs.view(slot, TRUST_DTYPE, SLOT_CELLS, TRUST_OFFSET)
        return TileState(cells, trust, self._columns.records(slot))

    def state(self, slot: int) -> TileState:
        """Return the same views, read-only."""
        state = self.writable(slot)
        for array in state.arrays:
            array.flags.writeable = False
        return state

    def records(self, slot: int) -> Records:
        """Return a read-only view of the slot's cells alone."""
        cells = self._slabs.view(slot, CELL_DTYPE, SLOT_CELLS)
        cells.flags.writeable = False
        return cells

    def known_rows(self, slot: int) -> int:
        """Return which rows of the slot hold a known cell: bit j for row j."""
        return int(known_rows(self.address[slot]))

    def based_rows(self, slot: int, known: int) -> int:
        """Return which of its ``known`` rows hold a based cell: bit j for row j."""
        return self._columns.rows(slot, known)
