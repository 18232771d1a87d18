"""The shelf: storage for the tiles that are not in memory."""

import numpy as np
import numpy.typing as npt

from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, TILE_CELLS, TRUST_DTYPE
from roughmap.tiles.places import PlacePool
from roughmap.tiles.state import TileState


class Shelf(PlacePool):
    """Places outside memory, one tile each. This base class has no room: all tiles then stay in memory.

    A subclass, such as a spill file, gives tiles a place to go. The content of a place must not change from `write`
    until the place is free.
    """

    @property
    def room(self) -> int:
        """Number of places that `allocate` can still hand out."""
        return 0

    def write(self, place: int, state: TileState, known: int, based: int) -> None:
        """Write a tile to an allocated place.

        ``known``: bit j is set if row j has a known cell. ``based``: the same for based cells; 0 without a column.
        Called without the lock. OSError if the write fails; the caller then releases the place.
        """
        raise NotImplementedError

    def read(self, place: int, room: TileState) -> bool:
        """Read a live or pinned place into zeroed arrays, all three; return whether the tile has a column.

        Rows without a known cell, and rows of the column without a based one, are not written. Called without the lock,
        from any thread. Raises if the content is not what was written.
        """
        raise NotImplementedError


def empty_state() -> TileState:
    """Return the three arrays of a tile, zeroed."""
    number = TILE_CELLS * TILE_CELLS
    return TileState(*(np.zeros(number, dtype) for dtype in (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE)))


def copy_known_rows(source: TileState, target: TileState) -> None:
    """Copy a tile onto zeroed arrays. Rows that hold nothing are skipped, so that their pages stay unallocated."""
    known = (_rows(source.cells)["count"] != 0).any(axis=1)
    _rows(target.cells)[known] = _rows(source.cells)[known]
    _rows(target.trust)[known] = _rows(source.trust)[known]
    if source.column is not None and target.column is not None:
        based = (_rows(source.column)["flags"] & BASED != 0).any(axis=1)
        _rows(target.column)[based] = _rows(source.column)[based]


def _rows(array: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    return array.reshape(TILE_CELLS, TILE_CELLS)


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
