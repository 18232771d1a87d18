"""Comparison of a ground map with its oracle, cell by cell and byte by byte."""

import numpy as np

from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, TILE_CELLS, TRUST_DTYPE
from roughmap.map import RoughMap
from roughmap.reference.ground import GroundOracle

Found = dict[tuple[int, int], tuple[bytes, bytes, bytes]]
"""Cell, trust and column by (i, j)."""


def written(m: RoughMap) -> Found:
    """Return all that a map holds, but for cells of which all is zero, and check that columns are where they belong."""
    found: Found = {}
    base = m._table.levels[0]
    for n in range(base.size):
        i0, j0 = int(base.tx[n]) * TILE_CELLS, int(base.ty[n]) * TILE_CELLS
        state = m._table.state(int(m._table.slot[n]))
        cells, trust = state.cells, state.trust
        column = np.zeros(len(cells), COLUMN_DTYPE) if state.column is None else state.column
        assert (state.column is not None) == bool((column["flags"] & BASED).any())
        parts = [np.ascontiguousarray(part).view(np.uint8).reshape(len(cells), -1) for part in (cells, trust, column)]
        for k in np.flatnonzero(np.column_stack([part.any(axis=1) for part in parts]).any(axis=1)).tolist():
            cell, known, above = (part[k].tobytes() for part in parts)
            found[i0 + k % TILE_CELLS, j0 + k // TILE_CELLS] = cell, known, above
    return found


def expected(oracle: GroundOracle) -> Found:
    """Return all that the oracle holds."""
    return {place: tuple(part.tobytes() for part in parts) for place, parts in oracle.records().items()}


def told(found: Found, place: tuple[int, int]) -> str:
    """Return a cell in words, for a failure."""
    if place not in found:
        return "nothing"
    parts = zip(found[place], (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE), strict=True)
    return "\n".join(str(np.frombuffer(part, kind)[0]) for part, kind in parts)


def check(m: RoughMap, oracle: GroundOracle) -> None:
    """Compare the bytes of all cells."""
    got, wanted = written(m), expected(oracle)
    for place in sorted(got.keys() | wanted.keys()):
        assert got.get(place) == wanted.get(place), (
            f"cell {place}: got\n{told(got, place)}\nexpected\n{told(wanted, place)}"
        )
