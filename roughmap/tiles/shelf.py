"""The shelf: storage for the tiles that are not in memory."""

from roughmap.arrays import Records
from roughmap.cell import TILE_CELLS
from roughmap.tiles.places import PlacePool


class Shelf(PlacePool):
    """Places outside memory, one tile each. This base class has no room: all tiles then stay in memory.

    A subclass, such as a spill file, gives tiles a place to go. The content of a place must not change from `write`
    until the place is free.
    """

    @property
    def room(self) -> int:
        """Number of places that `allocate` can still hand out."""
        return 0

    def write(self, place: int, records: Records, rows: int) -> None:
        """Write a tile's (4096,) records to an allocated place; ``rows``: bit j is set if row j has a known cell.

        Called without the lock. OSError if the write fails; the caller then releases the place.
        """
        raise NotImplementedError

    def read(self, place: int, records: Records) -> None:
        """Read a live or pinned place into (4096,) zeroed records; rows without a known cell are not written.

        Called without the lock, from any thread. Raises if the content is not what was written.
        """
        raise NotImplementedError


def copy_known_rows(source: Records, target: Records) -> None:
    """Copy (4096,) records onto zeroed ones. Rows without a known cell are skipped: their pages stay unallocated."""
    rows = source.reshape(TILE_CELLS, TILE_CELLS)
    known = (rows["count"] != 0).any(axis=1)
    target.reshape(TILE_CELLS, TILE_CELLS)[known] = rows[known]


def runs_of(rows: int) -> list[tuple[int, int]]:
    """Return the runs (start, stop) of set bits."""
    found = []
    start = 0
    while rows >> start:
        while not rows >> start & 1:
            start += 1
        stop = start
        while rows >> stop & 1:
            stop += 1
        found.append((start, stop))
        start = stop
    return found
