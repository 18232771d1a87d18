"""Where tiles live: slots of 4096 cells, in slabs of anonymous memory that kernels reach by address."""

import contextlib
import mmap

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I4, U8, Flags, Records, Scalar
from roughmap.cell import CELL_DTYPE, TILE_CELLS
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel

SLOT_CELLS = TILE_CELLS * TILE_CELLS
SLOT_BYTES = SLOT_CELLS * CELL_DTYPE.itemsize
SLAB_SLOTS = 64
DENSE_ROWS = 48
"""A tile with at least so many rows known costs little more when all of its memory is there."""

KEPT_SLOTS = 128
"""Free dense slots that keep their memory, 32 MiB: while somebody reads, each scan copies the tiles that it changes,
and page faults would cost more than the copies."""

CELL_WORDS = CELL_DTYPE.itemsize // 8
"""Eight-byte words of a cell: word 0 is count | updated << 32, words 1..7 are the floats in the dtype's order."""


@inline
def floats(address: Scalar) -> F8:
    """The slot at ``address`` as 8 * 4096 float64 words; words that are multiples of 8 hold no float."""
    return carray(pointer(address, np.float64(0.0)), (SLOT_CELLS * CELL_WORDS,))


@inline
def words(address: Scalar) -> U8:
    """The slot at ``address`` as 8 * 4096 uint64 words."""
    return carray(pointer(address, np.uint64(0)), (SLOT_CELLS * CELL_WORDS,))


@kernel
def _copy_known_rows(source: Scalar, target: Scalar) -> None:
    """Copy a slot onto a zeroed one. Rows without a known cell are left alone: their page is never touched."""
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
    """Which rows of a slot hold a known cell: bit j for row j."""
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


class Places:
    """Numbered places that are handed out, counted by pins, and free again when neither map nor reader needs them.

    All methods are the writer's, under its lock. What a place is, and how more come to be, the subclasses say.
    """

    def __init__(self) -> None:
        self.pins = np.zeros(0, np.int32)
        self.live = np.zeros(0, np.bool_)
        self._free: list[int] = []

    @property
    def used(self) -> int:
        """Places that are not free."""
        return len(self.pins) - len(self._free)

    def _extend(self, number: int) -> None:
        """So many more free places, handed out in their order. All or none, as with all growth: memory is taken before
        anything changes."""
        first = len(self.pins)
        pins = np.append(self.pins, np.zeros(number, np.int32))
        live = np.append(self.live, np.zeros(number, np.bool_))
        free = [*self._free, *range(first + number - 1, first - 1, -1)]
        self.pins, self.live, self._free = pins, live, free

    def _grow(self) -> None:
        """At least one more place; MemoryError if there can be none."""
        raise NotImplementedError

    def _vacated(self, place: int) -> None:
        """Nobody needs what is in this place any more: it is free."""
        self._free.append(place)

    def allocate(self, number: int) -> I4:
        """``number`` places, live. All or none: MemoryError leaves them as they were, or more."""
        while len(self._free) < number:
            self._grow()
        taken = self._free[len(self._free) - number :]
        del self._free[len(self._free) - number :]
        places = np.array(taken[::-1], np.int32)
        self.live[places] = True
        return places

    def release(self, places: I4) -> None:
        """The map no longer uses these places. Those that are pinned are freed by their last unpin."""
        self.live[places] = False
        self._free_dead(places)

    def pin(self, places: I4) -> None:
        """Keep what these (different) places hold unchanged until they are unpinned as often."""
        self.pins[places] += 1

    def unpin(self, places: I4) -> None:
        """Undo one :meth:`pin`."""
        self.pins[places] -= 1
        self._free_dead(places)

    def _free_dead(self, places: I4) -> None:
        for place in places[(self.pins[places] == 0) & ~self.live[places]].tolist():
            self._vacated(place)


class SlotPool(Places):
    """Slots of 256 KiB in memory, handed out zeroed, given back to the system when freed.

    Slabs are private anonymous maps of zero pages: one row of 64 cells is one page, so that a tile of which only a
    part is known costs only the rows that were written. Tiles of which most is known, or soon will be, come into slabs
    of their own, of huge pages: a page fault costs more than the update of a hundred cells. A slab never moves and is
    never unmapped while a view of it is alive. :meth:`records` and :meth:`copy` of pinned slots need no lock.
    """

    def __init__(self) -> None:
        super().__init__()
        self._slabs: list[mmap.mmap] = []
        self._free_dense: list[int] = []
        self._written: set[int] = set()  # free dense slots that kept their memory, and what was in it
        self.address = np.zeros(0, np.uint64)
        self.dense = np.zeros(0, np.bool_)

    @property
    def used(self) -> int:
        """Slots that are not free."""
        return super().used - len(self._free_dense)

    def _map(self, advice: int) -> None:
        """Another slab; its slots are the last of `_free`."""
        try:
            slab = mmap.mmap(-1, SLAB_SLOTS * SLOT_BYTES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        except OSError as error:  # which is what the system's refusal comes as
            raise MemoryError(f"no memory for {SLAB_SLOTS} more tiles: {error.strerror}") from None
        with contextlib.suppress(OSError):  # a kernel without huge pages knows no such advice
            slab.madvise(advice)
        start = np.frombuffer(slab, np.uint8).ctypes.data
        slabs = [*self._slabs, slab]
        address = np.append(self.address, np.uint64(start) + np.arange(SLAB_SLOTS, dtype=np.uint64) * SLOT_BYTES)
        dense = np.append(self.dense, np.full(SLAB_SLOTS, advice == mmap.MADV_HUGEPAGE))
        self._extend(SLAB_SLOTS)
        self._slabs, self.address, self.dense = slabs, address, dense

    def _grow(self) -> None:
        self._map(mmap.MADV_NOHUGEPAGE)  # with huge pages, one known row would cost eight tiles

    def _grow_dense(self) -> None:
        self._map(mmap.MADV_HUGEPAGE)
        self._free_dense += self._free[-SLAB_SLOTS:]
        del self._free[-SLAB_SLOTS:]

    def allocate(self, number: int, dense: Flags | None = None) -> I4:
        """``number`` zeroed slots; ``dense`` (number,): for tiles of which most will be known."""
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

    def _vacated(self, place: int) -> None:
        if self.dense[place] and len(self._written) < KEPT_SLOTS:
            self._written.add(place)
        else:
            self._give_back(place)
        if self.dense[place]:
            self._free_dense.append(place)
        else:
            self._free.append(place)

    def _give_back(self, slot: int) -> None:
        """The slot's pages go back to the system; the next reader of them sees zeros."""
        slab, number = divmod(slot, SLAB_SLOTS)
        self._slabs[slab].madvise(mmap.MADV_DONTNEED, number * SLOT_BYTES, SLOT_BYTES)

    def trim(self) -> None:
        """Where memory is short: no free slot keeps any."""
        while self._written:
            self._give_back(self._written.pop())

    def copy(self, source: int, target: int) -> None:
        """Copy slot ``source`` onto the zeroed slot ``target``."""
        _copy_known_rows(self.address[source], self.address[target])

    def writable(self, slot: int) -> Records:
        """The slot's (4096,) CELL_DTYPE records, j outer, i inner; a view, not a copy."""
        slab, place = divmod(int(slot), SLAB_SLOTS)
        return np.frombuffer(self._slabs[slab], CELL_DTYPE, SLOT_CELLS, place * SLOT_BYTES)

    def records(self, slot: int) -> Records:
        """The same, read-only."""
        view = self.writable(slot)
        view.flags.writeable = False
        return view

    def known_rows(self, slot: int) -> int:
        """Which of the slot's rows hold a known cell: bit j for row j."""
        return int(_known_rows(self.address[slot]))

    def is_dense(self, slot: int) -> bool:
        """Whether the slot is for tiles of which most is known, or should be."""
        return bool(self.dense[slot]) or self.known_rows(slot).bit_count() >= DENSE_ROWS
