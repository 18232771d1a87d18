"""The state of a tile, as stores, shelves and readers see it."""

from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roughmap.arrays import Records
from roughmap.cell import CELL_DTYPE, COLUMN_DTYPE, TILE_CELLS, TRUST_DTYPE


class TileState(NamedTuple):
    """The three arrays of a tile, (4096,) each, j outer, i inner.

    ``cells`` of CELL_DTYPE, ``trust`` of TRUST_DTYPE, ``column`` of COLUMN_DTYPE; None if no cell has a column.
    """

    cells: Records
    trust: Records
    column: Records | None

    @classmethod
    def of_bytes(cls, raw: bytes) -> Self:
        """Return read-only views of the arrays, which lie one after another in ``raw``."""
        number = TILE_CELLS * TILE_CELLS
        trust, column = number * CELL_DTYPE.itemsize, number * (CELL_DTYPE.itemsize + TRUST_DTYPE.itemsize)
        return cls(
            np.frombuffer(raw, CELL_DTYPE, number),
            np.frombuffer(raw, TRUST_DTYPE, number, trust),
            np.frombuffer(raw, COLUMN_DTYPE, number, column) if len(raw) > column else None,
        )

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in self.arrays)

    @property
    def arrays(self) -> tuple[npt.NDArray[np.void], ...]:
        """The arrays that there are, in the order in which they are stored and digested."""
        return (self.cells, self.trust) if self.column is None else (self.cells, self.trust, self.column)
