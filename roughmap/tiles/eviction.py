"""Moving tiles from memory to the shelf while readers and the map go on."""

import numpy as np

from roughmap.arrays import I4
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.table import TileTable


class Eviction:
    """The eviction of some tiles: chosen under the map's lock, written without it, dropped from memory under it.

    The least recently used tiles are chosen. Tiles that a reader has pinned are not, since their memory would not be
    freed.

    Attributes:
        number: number of tiles chosen; fewer than requested if there are no more, or if the shelf has no more room.
        short: whether the room on the shelf was the limit.
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
        self._tiles = table.levels[0].tx[self._entries], table.levels[0].ty[self._entries]
        self._digests = table.digests.digest[self._entries]
        self._known = table.digests.known[self._entries]
        self._places = table.shelf.allocate(number)
        self._written = 0
        table.pool.pin(self._slots)

    def write(self) -> None:
        """Write the tiles to the shelf, one by one, without the lock. OSError if the shelf cannot take one."""
        pool, shelf = self._table.pool, self._table.shelf
        for n, (slot, place) in enumerate(zip(self._slots.tolist(), self._places.tolist(), strict=True)):
            state, known = pool.state(slot), pool.known_rows(slot)
            if not self._known[n]:
                self._digests[n] = np.frombuffer(tile_digest(state), np.uint8)
            shelf.write(place, state, known, pool.based_rows(slot, known))
            self._written = n + 1

    def close(self) -> None:
        """Drop the tiles that were written and have not changed meanwhile from memory; call it under the lock."""
        table = self._table
        # The slots are pinned: a tile that changed meanwhile has moved to a new slot, and this one is no longer live.
        gone = (np.arange(self.number) < self._written) & table.pool.live[self._slots]
        # Tiles that were forgotten meanwhile have changed the numbers of the others' entries.
        tx, ty = self._tiles
        entries = table.levels[0].find_each(tx[gone], ty[gone])
        table.digests.set(entries, self._digests[gone])
        table.slot[entries] = ~self._places[gone]
        table.pool.unpin(self._slots)
        table.pool.release(self._slots[gone])
        table.pool.trim()
        table.shelf.release(self._places[~gone])
