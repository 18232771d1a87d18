"""The sparse table of tiles: which exist, where each lies, when each changed."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from roughmap.arrays import I4, U1, U8, Flags, Records
from roughmap.cell import TILE_CELLS
from roughmap.tiles.changes import mark_changed
from roughmap.tiles.digest import TileDigests, tile_digest
from roughmap.tiles.index import LevelIndex, TileBox, grown, kept_rows
from roughmap.tiles.shelf import Shelf, empty_state
from roughmap.tiles.slots import SlotPool
from roughmap.tiles.state import TileState

ReaderLock = Callable[[], AbstractContextManager[object]]
"""Returns a context manager that holds the lock under which readers pin tiles."""

_WHOLE = np.iinfo(np.uint64).max


class TileTable:
    """Tiles of level 0 with their slots and stamps, and the tiles of the levels above with their sequences.

    An entry of level 0 is a row of ``slot``, ``used``, ``oldest_ns``, ``newest_ns``, of ``digests`` and of
    ``levels[0]`` (tx, ty, sequence). ``levels[z]`` holds the ancestors of every tile, z levels up. Every tile in the
    table has a known cell. A ``slot`` >= 0 is a slot of the pool; a negative one means place ``~slot`` of the shelf,
    and the digest is then known. ``used`` is the sequence at which the tile was last needed. ``rings``: the width of
    the ring around a tile at each level, see `mark_changed`.

    Only the writer calls these methods, under its lock. Exceptions: the writer calls :meth:`bring_back` and
    :meth:`refresh_digests` without the lock, and any thread may call :meth:`state` and :meth:`records` for slots that
    it has pinned.
    """

    def __init__(self, rings: tuple[int, ...], shelf: Shelf) -> None:
        self.rings = rings
        self.levels = [LevelIndex() for _ in rings]
        self.pool = SlotPool()
        self.shelf = shelf
        self.slot = np.zeros(0, np.int32)
        self.used = np.zeros(0, np.int64)
        self.oldest_ns = np.zeros(0, np.int64)
        self.newest_ns = np.zeros(0, np.int64)
        self.digests = TileDigests(self.levels[0])

    @property
    def size(self) -> int:
        """Number of tiles of level 0."""
        return self.levels[0].size

    @property
    def nbytes(self) -> int:
        """Upper limit of the bytes in use: whole slots and the tables."""
        arrays = (self.slot, self.used, self.oldest_ns, self.newest_ns)
        tables = sum(a.nbytes for a in arrays) + sum(level.nbytes for level in self.levels)
        return self.pool.nbytes + tables + self.digests.nbytes

    @property
    def resident(self) -> int:
        """Number of tiles of level 0 that are in memory."""
        return int(np.count_nonzero(self.slot[: self.size] >= 0))

    def insert(
        self, tx: I4, ty: I4, slots: I4 | None = None, dense: Flags | None = None, *, columns: bool = False
    ) -> I4:
        """Insert (T,) different new tiles with ``slots`` (None: a zeroed slot each) and return their entries.

        ``dense`` (T,): see `SlotPool.allocate`. ``columns``: each new slot takes a column. All memory is allocated
        before anything changes: after a MemoryError the table is as it was.
        """
        number = len(tx)
        for level in self.levels:
            level.reserve(number)
        capacity = self.levels[0].capacity
        if capacity > len(self.slot):
            slot, used = grown(self.slot, capacity), grown(self.used, capacity)
            oldest_ns, newest_ns = grown(self.oldest_ns, capacity), grown(self.newest_ns, capacity)
            self.digests.reserve(capacity)
            self.slot, self.used, self.oldest_ns, self.newest_ns = slot, used, oldest_ns, newest_ns
        if slots is None:
            slots = self._new_slots(number, dense, columns=columns)
        first = self.size
        for shift, level in enumerate(self.levels):
            level.insert(tx, ty, shift)
        entries = np.arange(first, first + number, dtype=np.int32)
        self.slot[entries] = slots
        self.digests.add(entries)
        return entries

    def _new_slots(self, number: int, dense: Flags | None = None, *, columns: bool) -> I4:
        """Return zeroed slots, each with a column if ``columns``; MemoryError, and no change, if there is no room."""
        slots = self.pool.allocate(number, dense)
        if columns:
            try:
                self.pool.take_columns(slots)
            except MemoryError:
                self.pool.release(slots)
                raise
        return slots

    def open(self, entries: I4, tx: I4, ty: I4, dense: Flags, *, columns: bool) -> tuple[I4, I4]:
        """Make (T,) different tiles ready to be written; return their entries and the slots that took a column.

        ``entries``: those of the tiles, which are in memory; -1 for new ones, which are inserted, ``dense`` (see
        `SlotPool.allocate`) or not. With ``columns`` each tile has a column after that; those that stay unwritten are
        to be dropped (`SlotPool.drop_columns`). ValueError if a tile is on the shelf. After that or a MemoryError every
        tile still has the same cells, and none is new.
        """
        entries, new = entries.copy(), np.flatnonzero(entries < 0)
        known = entries[entries >= 0]
        self.make_writable(known)
        taken = self.pool.take_columns(self.slot[known]) if columns else np.zeros(0, np.int32)
        if len(new):
            try:
                entries[new] = self.insert(tx[new], ty[new], dense=dense[new], columns=columns)
            except MemoryError:
                self.pool.drop_columns(taken)
                raise
            taken = np.concatenate([taken, self.slot[entries[new]]]) if columns else taken
        return entries, taken

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
            slots = self._new_slots(len(entries), columns=True)
        based = np.zeros(len(entries), np.bool_)
        try:
            for n, (place, slot) in enumerate(zip(places.tolist(), slots.tolist(), strict=True)):
                based[n] = self.shelf.read(place, self.pool.writable(slot))
        except BaseException:
            with reader_lock():
                self.pool.release(slots)
            raise
        with reader_lock():
            self.pool.drop_columns(slots[~based])
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
        self.slot[shared] = self.pool.duplicate(old)
        self.pool.release(old)

    def mark_changed(self, entries: I4, tx: I4, ty: I4, bits: U8, now: int) -> None:
        """Note that the tiles ``entries``, with the numbers ``tx``, ``ty``, changed in the cells ``bits`` (T, 64).

        Their digests are discarded, and tiles of all levels get the sequence ``now``, see `mark_changed`.
        """
        self.digests.outdate(entries)
        self._mark(tx, ty, bits, now)

    def _mark(self, tx: I4, ty: I4, bits: U8, now: int) -> None:
        for z, (level, ring) in enumerate(zip(self.levels, self.rings, strict=True)):
            mark_changed(z, ring, level.table, level.keys, level.sequence, tx, ty, bits, now)

    def forget(self, entries: I4, now: int) -> None:
        """Remove (T,) different tiles; their neighbours and what is above them get the sequence ``now``.

        All their cells count as changed, so that no tile must be read. The remaining entries are numbered anew. A
        MemoryError leaves the table as it was.
        """
        base = self.levels[0]
        tx, ty, slots = base.tx[entries], base.ty[entries], self.slot[entries]
        stays = np.ones(self.size, np.bool_)
        stays[entries] = False
        kept = np.flatnonzero(stays).astype(np.int32)
        levels = [base.only(kept)]
        for level in self.levels[1:]:
            levels.append(level.only(level.with_children(levels[-1])))
        digests = self.digests.only(kept, levels[0])
        slot, used = kept_rows(self.slot, kept), kept_rows(self.used, kept)
        oldest_ns, newest_ns = kept_rows(self.oldest_ns, kept), kept_rows(self.newest_ns, kept)
        whole = np.full((len(entries), TILE_CELLS), _WHOLE, np.uint64)
        self.slot, self.used, self.oldest_ns, self.newest_ns = slot, used, oldest_ns, newest_ns
        self.levels, self.digests = levels, digests
        self._mark(tx, ty, whole, now)
        self._release(slots)

    def clear(self) -> None:
        """Release all slots and places; those that readers have pinned stay until they are unpinned."""
        self._release(self.slot[: self.size])

    def _release(self, slots: I4) -> None:
        self.pool.release(slots[slots >= 0])
        self.shelf.release(~slots[slots < 0])

    def select(self, box: TileBox | None = None) -> I4:
        """Return the entries of the level-0 tiles in ``box`` (None: all), ascending by (tx, ty)."""
        return self.levels[0].entries(box)

    def refresh_digests(self) -> None:
        """Compute the digests of the tiles that have changed since the last call."""
        if not self.digests.outdated:
            return
        entries = np.array(sorted(self.digests.outdated), np.int32)
        found = np.empty((len(entries), 16), np.uint8)
        for n, slot in enumerate(self.slot[entries].tolist()):
            found[n] = np.frombuffer(tile_digest(self.state(slot)), np.uint8)
        self.digests.set(entries, found)

    def tile_digests(self) -> tuple[I4, I4, U1]:
        """Return (tx, ty, digests (T, 16)) of the level-0 tiles, ascending by (tx, ty)."""
        self.refresh_digests()
        entries, base = self.select(), self.levels[0]
        return base.tx[entries], base.ty[entries], self.digests.digest[entries]

    def pin(self, slots: I4) -> None:
        """Keep the bytes of these slots, all different, unchanged until :meth:`unpin`."""
        self.pool.pin(slots[slots >= 0])
        self.shelf.pin(~slots[slots < 0])

    def unpin(self, slots: I4) -> None:
        """Undo one :meth:`pin`; slots that the map has released meanwhile become free."""
        self.pool.unpin(slots[slots >= 0])
        self.shelf.unpin(~slots[slots < 0])

    def state(self, slot: int) -> TileState:
        """Return the slot's arrays, read-only, valid while pinned.

        Views for a tile in memory; a tile on the shelf is read from there.
        """
        if slot >= 0:
            return self.pool.state(slot)
        room = empty_state()
        state = room if self.shelf.read(~slot, room) else room._replace(column=None)
        for array in state.arrays:
            array.flags.writeable = False
        return state

    def records(self, slot: int) -> Records:
        """Return the slot's (4096,) CELL_DTYPE records alone, under the same conditions."""
        return self.pool.records(slot) if slot >= 0 else self.state(slot).cells
