"""The sparse table of tiles: which exist, where each lies, when each changed."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from roughmap.arrays import I4, U1, Flags, Records
from roughmap.cell import CELL_DTYPE
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.index import LevelIndex, TileBox, grown
from roughmap.tiles.shelf import Shelf
from roughmap.tiles.slots import SLOT_BYTES, SLOT_CELLS, SlotPool

ReaderLock = Callable[[], AbstractContextManager[object]]
"""Returns a context manager that holds the lock under which readers pin tiles."""


class TileTable:
    """Tiles of level 0 with their slots and stamps, and the tiles of the levels above with their sequences.

    An entry of level 0 is a row of ``slot``, ``used``, ``oldest_ns``, ``newest_ns``, ``digest``, ``digest_known`` and
    of ``levels[0]`` (tx, ty, sequence). ``levels[z]`` holds the ancestors of every tile, z levels up. Every tile in the
    table has a known cell. A ``slot`` >= 0 is a slot of the pool; a negative one means place ``~slot`` of the shelf,
    and the digest is then known. ``used`` is the sequence at which the tile was last needed.

    Only the writer calls these methods, under its lock. Exceptions: the writer calls :meth:`bring_back` and
    :meth:`digests` without the lock (a reader sees a digest complete or as not known), and any thread may call
    :meth:`records` for slots that it has pinned.
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
        """Number of tiles of level 0."""
        return self.levels[0].size

    @property
    def nbytes(self) -> int:
        """Upper limit of the bytes in use: whole slots and the tables."""
        arrays = (self.slot, self.used, self.oldest_ns, self.newest_ns, self.digest, self.digest_known)
        return self.pool.used * SLOT_BYTES + sum(a.nbytes for a in arrays) + sum(level.nbytes for level in self.levels)

    @property
    def resident(self) -> int:
        """Number of tiles of level 0 that are in memory."""
        return int(np.count_nonzero(self.slot[: self.size] >= 0))

    def insert(self, tx: I4, ty: I4, slots: I4 | None = None, dense: Flags | None = None) -> I4:
        """Insert (T,) different new tiles with ``slots`` (None: a zeroed slot each) and return their entries.

        ``dense`` (T,): see `SlotPool.allocate`. All memory is allocated before anything changes: after a MemoryError
        the table is as it was.
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

    def bring_back(self, entries: I4, reader_lock: ReaderLock) -> None:
        """Read those of these tiles that are on the shelf back into memory. The writer calls it without its lock.

        ``reader_lock`` is held only for the moments at which the table changes, never while the shelf is read; that is
        safe because only the writer moves tiles. A MemoryError, or an error of the shelf, leaves the table as it was.
        """
        entries = entries[self.slot[entries] < 0]
        if not len(entries):
            return
        places = ~self.slot[entries]
        with reader_lock():
            slots = self.pool.allocate(len(entries))
        try:
            for place, slot in zip(places.tolist(), slots.tolist(), strict=True):
                self.shelf.read(place, self.pool.writable(slot))
        except BaseException:
            with reader_lock():
                self.pool.release(slots)
            raise
        with reader_lock():
            self.slot[entries] = slots
            self.shelf.release(places)

    def make_writable(self, entries: I4) -> None:
        """Move those of these tiles that readers have pinned to new slots, so that all can be written (copy on write).

        ValueError if a tile is not in memory. After that or a MemoryError every tile still has the same cells.
        """
        if (self.slot[entries] < 0).any():
            raise ValueError("expected tiles in memory, found one on the shelf")
        shared = entries[self.pool.pins[self.slot[entries]] > 0]
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
        """Release all slots and places; those that readers have pinned stay until they are unpinned."""
        slots = self.slot[: self.size]
        self.pool.release(slots[slots >= 0])
        self.shelf.release(~slots[slots < 0])

    def select(self, box: TileBox | None = None) -> I4:
        """Return the entries of the level-0 tiles in ``box`` (None: all), ascending by (tx, ty)."""
        return self.levels[0].entries(box)

    def digests(self) -> tuple[I4, I4, U1]:
        """Return (tx, ty, digests (T, 16)) of the level-0 tiles, ascending by (tx, ty); compute those not known yet."""
        entries = self.select()
        for entry in entries[~self.digest_known[entries]].tolist():
            self.digest[entry] = np.frombuffer(tile_digest(self.records(int(self.slot[entry]))), np.uint8)
            self.digest_known[entry] = True
        base = self.levels[0]
        return base.tx[entries], base.ty[entries], self.digest[entries]

    def pin(self, slots: I4) -> None:
        """Keep the bytes of these slots, all different, unchanged until :meth:`unpin`."""
        self.pool.pin(slots[slots >= 0])
        self.shelf.pin(~slots[slots < 0])

    def unpin(self, slots: I4) -> None:
        """Undo one :meth:`pin`; slots that the map has released meanwhile become free."""
        self.pool.unpin(slots[slots >= 0])
        self.shelf.unpin(~slots[slots < 0])

    def records(self, slot: int) -> Records:
        """Return the slot's (4096,) CELL_DTYPE records, j outer, i inner, read-only, valid while pinned.

        A view for a tile in memory; a tile on the shelf is read from there.
        """
        if slot >= 0:
            return self.pool.records(slot)
        records = np.zeros(SLOT_CELLS, CELL_DTYPE)
        self.shelf.read(~slot, records)
        records.flags.writeable = False
        return records
