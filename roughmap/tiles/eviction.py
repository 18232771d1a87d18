"""The way of tiles out of memory, while readers read and the map may go on."""

import numpy as np

from roughmap.arrays import I4
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.table import TileTable


class Eviction:
    """Some tiles on their way to the shelf: chosen under the map's lock, written without it, left behind under it.

    The tiles are those that were not needed for the longest; none that a reader has pinned, which would not be freed.

    Attributes:
        number: how many tiles were chosen; fewer than asked for if there are no more, or the shelf has no room.
        short: whether the shelf's room was the reason.
    """

    def __init__(self, table: TileTable, number: int) -> None:
        slots = table.slot[: table.size]
        resident = np.flatnonzero(slots >= 0)
        cold = resident[table.pool.pins[slots[resident]] == 0]
        number = min(number, len(cold))
        self.short = table.shelf.room < number
        self.number = number = min(number, table.shelf.room)
        if 0 < number < len(cold):
            cold = cold[np.argpartition(table.used[cold], number - 1)]
        self._table = table
        self._entries: I4 = cold[:number].astype(np.int32)
        self._slots = table.slot[self._entries]
        self._digests = table.digest[self._entries]
        self._known = table.digest_known[self._entries]
        self._places = table.shelf.allocate(number)
        self._written = 0
        table.pool.pin(self._slots)

    def write(self) -> None:
        """Put the tiles on the shelf, one after the other; needs no lock. OSError if the shelf can't take one."""
        pool, shelf = self._table.pool, self._table.shelf
        for n, (slot, place) in enumerate(zip(self._slots.tolist(), self._places.tolist(), strict=True)):
            records = pool.records(slot)
            if not self._known[n]:
                self._digests[n] = np.frombuffer(tile_digest(records), np.uint8)
            shelf.write(place, records, pool.known_rows(slot))
            self._written = n + 1

    def close(self) -> None:
        """Under the lock: those tiles leave memory that were written and have not changed meanwhile."""
        table = self._table
        # A tile that was written meanwhile, being pinned, has another slot now: the map has left this one.
        gone = (np.arange(self.number) < self._written) & table.pool.live[self._slots]
        entries = self._entries[gone]
        table.digest[entries], table.digest_known[entries] = self._digests[gone], True
        table.slot[entries] = ~self._places[gone]
        table.pool.unpin(self._slots)
        table.pool.release(self._slots[gone])
        table.pool.trim()
        table.shelf.release(self._places[~gone])
