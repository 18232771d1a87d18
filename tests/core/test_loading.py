"""Tiles that are loaded: what is none of a map is refused by name, and nothing changes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from strategies import state_of

from roughmap import CELL_DTYPE, RoughMap
from roughmap.cell import BASED, COLUMN_DTYPE, SUPPORTED, TRUST_DTYPE
from roughmap.tiles.state import TileState


def a_tile() -> TileState:
    """Two known cells, of which one is based."""
    state = TileState(*(np.zeros(4096, dtype) for dtype in (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE)))
    assert state.column is not None
    state.cells["count"][[7, 4000]] = 1
    state.trust["variance"][7] = 0.5
    state.column["flags"][7] = BASED | SUPPORTED
    return state


def changed(part: str, name: str, value: int, cells: Any = slice(None)) -> TileState:
    state = a_tile()
    getattr(state, part)[name][cells] = value
    return state


BAD: dict[str, tuple[Callable[[], TileState], str]] = {
    "no known cell": (lambda: changed("cells", "count", 0), "expected a known cell"),
    "a column of which nothing is based": (lambda: changed("column", "flags", SUPPORTED), "with a based cell"),
    "a based cell that is unknown": (lambda: changed("column", "flags", BASED, 8), "no such cell unknown"),
    "cells as trust": (lambda: a_tile()._replace(trust=a_tile().cells), "TRUST_DTYPE"),
    "trust as column": (lambda: a_tile()._replace(column=a_tile().trust), "COLUMN_DTYPE"),
    "too few cells": (lambda: a_tile()._replace(cells=a_tile().cells[1:]), r"\(4096,\)"),
    "a square": (lambda: a_tile()._replace(cells=a_tile().cells.reshape(64, 64)), r"\(4096,\)"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_states(name: str) -> None:
    make, told = BAD[name]
    m = RoughMap(threads=1)
    m.load_tile(1, 1, a_tile(), 0, 0)
    before = state_of(m)
    with pytest.raises(ValueError, match=told):
        m.load_tile(0, 0, make(), 0, 0)
    assert state_of(m) == before
    m.load_tile(0, 0, a_tile(), 0, 0)


def test_a_loaded_tile_is_a_copy() -> None:
    m, state = RoughMap(threads=1), a_tile()
    m.load_tile(-3, 2, state, 5, 3_000_000_001)
    was = [array.tobytes() for array in state.arrays]
    for array in state.arrays:
        array.view(np.uint8)[:] = 255
    with m.freeze() as frozen:
        found = frozen.state(-3, 2)
        assert found is not None
        assert [array.tobytes() for array in found.arrays] == was
        assert not any(array.flags.writeable for array in found.arrays)
        assert frozen.stamps(-3, 2) == (5, 3_000_000_001)
        assert frozen.state(0, 0) is None
    assert m.newest_updated == 3
