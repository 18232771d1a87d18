"""Where tiles lie that are not in memory."""

from roughmap.arrays import Records
from roughmap.cell import TILE_CELLS
from roughmap.tiles.slots import Places


class Shelf(Places):
    """Places outside memory, a tile each. This one has none: whoever wants tiles to leave memory gives the map another.

    What is in a place does not change between `write` and the moment nobody needs it any more.
    """

    @property
    def room(self) -> int:
        """How many places `allocate` may still be asked for."""
        return 0

    def write(self, place: int, records: Records, rows: int) -> None:
        """Put a tile's (4096,) records into an allocated place; ``rows``: bit j for a row with a known cell.

        Without the lock. OSError if that fails; the place is then released as it is.
        """
        raise NotImplementedError

    def read(self, place: int, records: Records) -> None:
        """Fill the (4096,) zeroed records of a live or pinned place; rows without a known cell are left alone.

        Without the lock, from any thread. An exception if what is there is not what was written.
        """
        raise NotImplementedError


def copy_known_rows(source: Records, target: Records) -> None:
    """Copy (4096,) records onto zeroed ones. Rows without a known cell are left alone: their page is never touched."""
    rows = source.reshape(TILE_CELLS, TILE_CELLS)
    known = (rows["count"] != 0).any(axis=1)
    target.reshape(TILE_CELLS, TILE_CELLS)[known] = rows[known]


def runs_of(rows: int) -> list[tuple[int, int]]:
    """The runs (start, stop) of set bits."""
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
