"""The sparse table of tiles: what exists, where it lies, when it changed."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from roughmap.arrays import I4, U1, Flags, Records
from roughmap.cell import CELL_DTYPE
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.index import LevelIndex, TileBox, grown
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.slots import SLOT_BYTES, SLOT_CELLS, SlotPool

Hold = Callable[[], AbstractContextManager[object]]
"""Takes, for a moment, the lock under which readers pin tiles."""


class TileTable:
    """Tiles of level 0 with their slots and stamps, and the tiles above them with their sequences.

    Entries of level 0 number the rows of ``slot``, ``used``, ``oldest_ns``, ``newest_ns``, ``digest``, ``digest_known``
    and of ``levels[0]`` (tx, ty, sequence). ``levels[z]`` holds the ancestors of every tile, z levels up. A tile in the
    table has a known cell. ``slot`` is where it lies: of the pool if not negative, else the place ``~slot`` of the
    shelf; what lies there has its digest known. ``used`` is the sequence at which the tile was last needed.

    Everything is the writer's, under its lock, but :meth:`bring_back`, :meth:`digests`, which it calls without the lock
    (a reader finds a digest whole, or not known yet), and :meth:`records` of slots that the caller has pinned.
    """

    def __init__(self, levels: int, shelf: Shelf) -> None:
        self.levels = [LevelIndex() for _ in range(levels)]
        self.pool = SlotPool()
        self.shelf = shelf
        self.slot = np.zeros(0, np.int32)
        self.used = np.zeros(0, np.int64)
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
        arrays = (self.slot, self.used, self.oldest_ns, self.newest_ns, self.digest, self.digest_known)
        return self.pool.used * SLOT_BYTES + sum(a.nbytes for a in arrays) + sum(level.nbytes for level in self.levels)

    @property
    def resident(self) -> int:
        """Tiles of level 0 that are in memory."""
        return int(np.count_nonzero(self.slot[: self.size] >= 0))

    def insert(self, tx: I4, ty: I4, slots: I4 | None = None, dense: Flags | None = None) -> I4:
        """Give (T,) different tiles that are not there yet ``slots``, or a zeroed slot each; their entries.

        ``dense`` (T,): see `SlotPool.allocate`.

        All memory is taken before anything changes: after a MemoryError the table is as it was.
        """
        number = len(tx)
        for level in self.levels:
            level.reserve(number)
        capacity = self.levels[0].capacity
        if capacity > len(self.slot):
            slot, used = grown(self.slot, capacity), grown(self.used, capacity)
            oldest_ns, newest_ns = grown(self.oldest_ns, capacity), grown(self.newest_ns, capacity)
            digest, digest_known = grown(self.digest, capacity), grown(self.digest_known, capacity)
            self.slot, self.used, self.oldest_ns, self.newest_ns = slot, used, oldest_ns, newest_ns
            self.digest, self.digest_known = digest, digest_known
        if slots is None:
            slots = self.pool.allocate(number, dense)
        first = self.size
        for shift, level in enumerate(self.levels):
            level.insert(tx, ty, shift)
        entries = np.arange(first, first + number, dtype=np.int32)
        self.slot[entries] = slots
        return entries

    def bring_back(self, entries: I4, hold: Hold) -> None:
        """Those of these tiles that are on the shelf come into memory: the writer's, without its lock.

        ``hold`` is called for the moments at which readers would notice, and never while the shelf is read: only the
        writer takes tiles out of the table or out of memory. MemoryError, or the shelf's error, leaves all as it was.
        """
        entries = entries[self.slot[entries] < 0]
        if not len(entries):
            return
        places = ~self.slot[entries]
        with hold():
            slots = self.pool.allocate(len(entries))
        try:
            for place, slot in zip(places.tolist(), slots.tolist(), strict=True):
                self.shelf.read(place, self.pool.writable(slot))
        except BaseException:
            with hold():
                self.pool.release(slots)
            raise
        with hold():
            self.slot[entries] = slots
            self.shelf.release(places)

    def open(self, entries: I4) -> None:
        """Before these tiles are written: those that are pinned get a copy.

        ValueError if one is not in memory; that and MemoryError leave each tile with the cells that it had.
        """
        if (self.slot[entries] < 0).any():
            raise ValueError("expected tiles that are in memory")
        shared = entries[self.pool.pins[self.slot[entries]] > 0]  # copy-on-write
        if not len(shared):
            return
        old = self.slot[shared]
        dense = np.array([self.pool.is_dense(slot) for slot in old.tolist()])
        new = self.pool.allocate(len(shared), dense)
        for source, target in zip(old.tolist(), new.tolist(), strict=True):
            self.pool.copy(source, target)
        self.slot[shared] = new
        self.pool.release(old)

    def clear(self) -> None:
        """Give back all slots and places; what readers have pinned stays until they unpin it."""
        slots = self.slot[: self.size]
        self.pool.release(slots[slots >= 0])
        self.shelf.release(~slots[slots < 0])

    def select(self, box: TileBox | None = None) -> I4:
        """Entries of the level-0 tiles in ``box`` (inclusive tile numbers; None: all), ascending by (tx, ty)."""
        return self.levels[0].entries(box)

    def digests(self) -> tuple[I4, I4, U1]:
        """(tx, ty, digests (T, 16)) of the level-0 tiles, ascending by (tx, ty); those not known yet are made."""
        entries = self.select()
        for entry in entries[~self.digest_known[entries]].tolist():
            self.digest[entry] = np.frombuffer(tile_digest(self.records(int(self.slot[entry]))), np.uint8)
            self.digest_known[entry] = True
        base = self.levels[0]
        return base.tx[entries], base.ty[entries], self.digest[entries]

    def pin(self, slots: I4) -> None:
        """Keep the bytes of these (different) slots as they are, until :meth:`unpin`."""
        self.pool.pin(slots[slots >= 0])
        self.shelf.pin(~slots[slots < 0])

    def unpin(self, slots: I4) -> None:
        """Undo one :meth:`pin`; slots that the map has left meanwhile are freed."""
        self.pool.unpin(slots[slots >= 0])
        self.shelf.unpin(~slots[slots < 0])

    def records(self, slot: int) -> Records:
        """The slot's (4096,) CELL_DTYPE records, j outer, i inner, read-only, valid while pinned.

        A view of what is in memory; what is on the shelf is read.
        """
        if slot >= 0:
            return self.pool.records(slot)
        records = np.zeros(SLOT_CELLS, CELL_DTYPE)
        self.shelf.read(~slot, records)
        records.flags.writeable = False
        return records
