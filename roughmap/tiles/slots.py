"""Tiles in memory: slots of 4096 cells in slabs of anonymous memory, which kernels access by address."""

import contextlib
import mmap

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I4, U8, Flags, Records, Scalar
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel
from roughmap.tiles.places import PlacePool

SLOT_CELLS = TILE_CELLS * TILE_CELLS
SLOT_BYTES = SLOT_CELLS * CELL_DTYPE.itemsize
SLAB_SLOTS = 64
DENSE_ROWS = 48
"""A tile with at least this many known rows costs little more if all of its memory is allocated."""

KEPT_SLOTS = 128
"""Free dense slots that keep their memory, 32 MiB. While a reader holds tiles, each scan copies the tiles that it
changes, and page faults would cost more than the copies."""

CELL_WORDS = CELL_DTYPE.itemsize // 8
"""Eight-byte words of a cell: word 0 is count | updated << 32, words 1 to 7 are the floats in CELL_DTYPE's order."""


@inline
def floats(address: Scalar) -> F8:
    """Return the slot at ``address`` as 8 * 4096 float64 words. Every eighth word, from word 0 on, is not a float."""
    return carray(pointer(address, np.float64(0.0)), (SLOT_CELLS * CELL_WORDS,))


@inline
def words(address: Scalar) -> U8:
    """Return the slot at ``address`` as 8 * 4096 uint64 words."""
    return carray(pointer(address, np.uint64(0)), (SLOT_CELLS * CELL_WORDS,))


@kernel
def _copy_known_rows(source: Scalar, target: Scalar) -> None:
    """Copy a slot onto a zeroed one. Rows without a known cell are skipped, so that their pages stay unallocated."""
    a = words(source)
    b = words(target)
    row = TILE_CELLS * CELL_WORDS
    for j in range(TILE_CELLS):
        known = np.uint64(0)
        for i in range(TILE_CELLS):
            known |= a[j * row + i * CELL_WORDS]
        if known != 0:
            for k in range(row):
                b[j * row + k] = a[j * row + k]


@kernel
def _known_rows(address: Scalar) -> int:
    """Return which rows of a slot hold a known cell: bit j for row j."""
    a = words(address)
    row = TILE_CELLS * CELL_WORDS
    rows = np.uint64(0)
    for j in range(TILE_CELLS):
        known = np.uint64(0)
        for i in range(TILE_CELLS):
            known |= a[j * row + i * CELL_WORDS]
        if known != 0:
            rows |= np.uint64(1) << np.uint64(j)
    return rows  # type: ignore[return-value]


@kernel
def _clear(address: Scalar) -> None:
    a = words(address)
    for n in range(SLOT_CELLS * CELL_WORDS):
        a[n] = 0


class SlotPool(PlacePool):
    """Slots of 256 KiB in memory: zeroed when handed out, returned to the system when freed.

    Slabs are private anonymous maps of zero pages. One row of 64 cells is one page, so that a partly known tile costs
    only the rows that were written. Dense slots, for tiles that are mostly known or soon will be, lie in slabs of huge
    pages, because a page fault costs more than the update of a hundred cells. A slab never moves, and is never unmapped
    while a view of it is alive. :meth:`records` and :meth:`copy` of pinned slots need no lock.
    """

    def __init__(self) -> None:
        super().__init__()
        self._slabs: list[mmap.mmap] = []
        self._free_dense: list[int] = []
        self._written: set[int] = set()  # free dense slots that kept their memory and its content
        self.address = np.zeros(0, np.uint64)
        self.dense = np.zeros(0, np.bool_)

    @property
    def used(self) -> int:
        """Number of slots that are not free."""
        return super().used - len(self._free_dense)

    def _map(self, advice: int) -> None:
        """Add a slab; its slots are the last of `_free`."""
        try:
            slab = mmap.mmap(-1, SLAB_SLOTS * SLOT_BYTES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        except OSError as error:  # how mmap reports that memory is short
            raise MemoryError(f"no memory for {SLAB_SLOTS} more tiles: {error.strerror}") from None
        with contextlib.suppress(OSError):  # not supported by kernels without huge pages
            slab.madvise(advice)
        start = np.frombuffer(slab, np.uint8).ctypes.data
        slabs = [*self._slabs, slab]
        address = np.append(self.address, np.uint64(start) + np.arange(SLAB_SLOTS, dtype=np.uint64) * SLOT_BYTES)
        dense = np.append(self.dense, np.full(SLAB_SLOTS, advice == mmap.MADV_HUGEPAGE))
        self._extend(SLAB_SLOTS)
        self._slabs, self.address, self.dense = slabs, address, dense

    def _grow(self) -> None:
        self._map(mmap.MADV_NOHUGEPAGE)  # with huge pages, one known row would cost as much as eight tiles

    def _grow_dense(self) -> None:
        self._map(mmap.MADV_HUGEPAGE)
        self._free_dense += self._free[-SLAB_SLOTS:]
        del self._free[-SLAB_SLOTS:]

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

    def _recycle(self, place: int) -> None:
        if self.dense[place] and len(self._written) < KEPT_SLOTS:
            self._written.add(place)
        else:
            self._give_back(place)
        if self.dense[place]:
            self._free_dense.append(place)
        else:
            self._free.append(place)

    def _give_back(self, slot: int) -> None:
        """Return the slot's pages to the system; they read as zeros from then on."""
        slab, number = divmod(slot, SLAB_SLOTS)
        self._slabs[slab].madvise(mmap.MADV_DONTNEED, number * SLOT_BYTES, SLOT_BYTES)

    def trim(self) -> None:
        """Return the memory of all free slots, because memory is short."""
        while self._written:
            self._give_back(self._written.pop())

    def copy(self, source: int, target: int) -> None:
        """Copy slot ``source`` onto the zeroed slot ``target``."""
        _copy_known_rows(self.address[source], self.address[target])

    def writable(self, slot: int) -> Records:
        """Return a view of the slot's (4096,) CELL_DTYPE records, j outer, i inner."""
        slab, place = divmod(int(slot), SLAB_SLOTS)
        return np.frombuffer(self._slabs[slab], CELL_DTYPE, SLOT_CELLS, place * SLOT_BYTES)

    def records(self, slot: int) -> Records:
        """Return the same view, read-only."""
        view = self.writable(slot)
        view.flags.writeable = False
        return view

    def known_rows(self, slot: int) -> int:
        """Return which rows of the slot hold a known cell: bit j for row j."""
        return int(_known_rows(self.address[slot]))

    def is_dense(self, slot: int) -> bool:
        """Whether the slot is dense, or its tile is known well enough for a dense one."""
        return bool(self.dense[slot]) or self.known_rows(slot).bit_count() >= DENSE_ROWS
