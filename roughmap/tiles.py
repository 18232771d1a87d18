"""The sparse table of tiles: what exists, where it lies, when it changed."""

import numpy as np

from roughmap.arrays import I4, Records
from roughmap.index import Box, LevelIndex, grown
from roughmap.memory import SLOT_BYTES, SlotPool


class TileTable:
    """Tiles of level 0 with their slots and stamps, and the tiles above them with their sequences.

    Entries of level 0 number the rows of ``slot``, ``oldest_ns``, ``newest_ns``, ``digest``, ``digest_known`` and of
    ``levels[0]`` (tx, ty, sequence). ``levels[z]`` holds the ancestors of every tile, z levels up. A tile in the
    table has a known cell. Everything is the writer's, under its lock, but :meth:`records` and :meth:`known_cells`
    of slots that the caller has pinned.
    """

    def __init__(self, levels: int) -> None:
        self.levels = [LevelIndex() for _ in range(levels)]
        self.pool = SlotPool()
        self.slot = np.zeros(0, np.int32)
        self.oldest_ns = np.zeros(0, np.int64)
        self.newest_ns = np.zeros(0, np.int64)
        self.digest = np.zeros((0, 16), np.uint8)
        self.digest_known = np.zeros(0, np.bool_)

    @property
    def size(self) -> int:
        """Tiles of level 0."""
        return self.levels[0].size

    @property
    def nbytes(self) -> int:
        """Bytes taken at most: slots counted whole, and the tables."""
        arrays = (self.slot, self.oldest_ns, self.newest_ns, self.digest, self.digest_known)
        return self.pool.used * SLOT_BYTES + sum(a.nbytes for a in arrays) + sum(level.nbytes for level in self.levels)

    def insert(self, tx: I4, ty: I4) -> I4:
        """Give (T,) different tiles that are not there yet a zeroed slot each; their entries.

        All memory is taken before anything changes: after a MemoryError the table is as it was.
        """
        number = len(tx)
        for level in self.levels:
            level.reserve(number)
        capacity = self.levels[0].capacity
        if capacity > len(self.slot):
            self.slot = grown(self.slot, capacity)
            self.oldest_ns = grown(self.oldest_ns, capacity)
            self.newest_ns = grown(self.newest_ns, capacity)
            self.digest = grown(self.digest, capacity)
            self.digest_known = grown(self.digest_known, capacity)
        slots = self.pool.allocate(number)
        first = self.size
        for shift, level in enumerate(self.levels):
            level.insert(tx, ty, shift)
        entries = np.arange(first, first + number, dtype=np.int32)
        self.slot[entries] = slots
        return entries

    def unshare(self, entries: I4) -> None:
        """Before these tiles are written: those that are pinned get a copy of their own (copy-on-write)."""
        shared = entries[self.pool.pins[self.slot[entries]] > 0]
        if not len(shared):
            return
        old = self.slot[shared]
        new = self.pool.allocate(len(shared))
        for source, target in zip(old.tolist(), new.tolist(), strict=True):
            self.pool.copy(source, target)
        self.slot[shared] = new
        self.pool.release(old)

    def select(self, box: Box | None = None) -> I4:
        """Entries of the level-0 tiles in ``box`` (inclusive tile numbers; None: all), ascending by (tx, ty)."""
        return self.levels[0].entries(box)

    def pin(self, slots: I4) -> None:
        """Keep the bytes of these (different) slots as they are, until :meth:`unpin`."""
        self.pool.pin(slots)

    def unpin(self, slots: I4) -> None:
        """Undo one :meth:`pin`; slots that the map has left meanwhile are freed."""
        self.pool.unpin(slots)

    def records(self, slot: int) -> Records:
        """The slot's (4096,) CELL_DTYPE records, j outer, i inner; a read-only view, valid while pinned."""
        return self.pool.records(slot)

    def known_cells(self, slot: int) -> int:
        """Number of the slot's cells with a count."""
        return self.pool.known_cells(slot)
