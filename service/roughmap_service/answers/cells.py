"""Queries of ``maps/{map}/cells``: single cells by place, with their records and layers."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from roughmap.cell import BASED, BIN_HEIGHT, CELL_DTYPE, TILE_CELLS, TILE_SHIFT
from roughmap.tiles.state import TileState
from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.messages import CellAnswer, CellEntry, CellState, Hits, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import CellsQuery
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.plan import INT32, TILE_AREA, Answer, Plan, Reply

Cells = npt.NDArray[np.int64]

ENCODING = json_encoding("CellAnswer")


def plan_cells(reader: MapReader, parameters: str, payload: bytes) -> Plan:
    """Return the plan of a query; raise QueryFault."""
    asked = CellsQuery.parse(parameters, payload)
    cells = _cells(asked, reader.cell_size)
    tiles = np.unique(cells >> TILE_SHIFT, axis=0)
    return Plan(len(tiles) * TILE_AREA, lambda: _read(reader, asked, cells))


def _cells(asked: CellsQuery, cell_size: float) -> Cells:
    """Return the (N, 2) cells i, j = floor(x / a), floor(y / a) of the places; raise QueryFault."""
    with np.errstate(over="ignore"):  # an overflow is outside int32 as well
        cells = np.floor(np.array(asked.points, np.float64).reshape(-1, 2) / cell_size)
    outside = ~((cells >= -INT32) & (cells < INT32)).all(axis=1)
    if outside.any():
        place = asked.points[int(np.flatnonzero(outside)[0])]
        raise QueryFault(QueryCode.BAD_PARAMETER, f"x, y: expected places whose cell numbers are int32; found {place}")
    return cells.astype(np.int64)


@contextmanager
def _read(reader: MapReader, asked: CellsQuery, cells: Cells) -> Iterator[Answer]:
    """Read the tiles of the cells, and answer with one reply."""
    tolerance = reader.tolerance if asked.tolerance is None else asked.tolerance
    limits = reader.limits_of(asked)
    tiles = cells >> TILE_SHIFT
    low, high = (tiles.min(axis=0), tiles.max(axis=0)) if len(tiles) else (np.zeros(2, int), np.zeros(2, int))
    box = int(low[0]), int(low[1]), int(high[0]), int(high[1])
    with reader.frozen([(0, box)]) as state:
        frozen = state.levels[0]
        entries: list[CellEntry | None] = [None] * len(cells)
        distinct, which = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        starts = np.searchsorted(which.ravel()[order], np.arange(len(distinct) + 1))
        for number, (x, y) in enumerate(distinct.tolist()):
            state_of_tile = frozen.state(x, y)
            layers = frozen.tile_layers(x, y, asked.layers, tolerance, limits)
            for place in order[starts[number] : starts[number + 1]].tolist():
                i, j = cells[place].tolist()
                row, column = j - y * TILE_CELLS, i - x * TILE_CELLS
                entries[place] = CellEntry(
                    x=asked.points[place][0],
                    y=asked.points[place][1],
                    i=i,
                    j=j,
                    state=_cell_state(state_of_tile, row, column),
                    layers={name: float(plane[row, column]) for name, plane in layers.items()},
                )
    answer = CellAnswer(
        map=reader.served.map,
        instance=reader.served.instance,
        epoch=state.epoch,
        sequence=state.sequence,
        cells=[entry for entry in entries if entry is not None],
    )
    yield Answer(state.sequence, [Reply(reader.keys.cells, model_bytes(answer), ENCODING)])


TRUST_MEMBERS = ("variance", "shared", "pose_variance", "mount_sigma")


def _cell_state(state: TileState | None, row: int, column: int) -> CellState | None:
    """Return what the map holds of a cell; None if no point ever hit it."""
    cell = row * TILE_CELLS + column
    if state is None or state.cells[cell]["count"] == 0:
        return None
    record, trust = state.cells[cell], state.trust[cell]
    values = {name: record[name].item() for name in CELL_DTYPE.names or ()}
    values |= {name: trust[name].item() for name in TRUST_MEMBERS}
    if state.column is not None and state.column[cell]["flags"] & BASED:
        values["off_ground"] = _hits(state.column[cell])
    return CellState(**values)


def _hits(column: np.void) -> list[Hits]:
    """Return the bins of a column that hold a hit, ascending."""
    low, high = column["bins"] & 15, column["bins"] >> 4
    hits = np.stack((low, high), axis=-1).ravel()
    first = 2 * int(column["base"])
    return [Hits(height=(first + k + 0.5) * BIN_HEIGHT, hits=int(hits[k])) for k in np.flatnonzero(hits).tolist()]
