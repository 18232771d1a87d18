"""Queries of ``maps/{map}/region``: the cells over a box at one level, as one Grid."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from roughmap.reading.layers import unknown_value
from roughmap.reading.region import CellBox, cell_box, overlap, tile_box
from roughmap_schemas.encodings import GRID
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.grid import Compression, encode_packed
from roughmap_schemas.messages import TileInfo, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import Bbox, RegionQuery
from roughmap_service.answers.drawing import Drawing
from roughmap_service.answers.map_reader import MapReader, MapState
from roughmap_service.answers.plan import INT32, Plan, Reply

CELL_BYTES = 64
"""Memory that a running cell may take; as much as its record in the map."""


def plan_region(reader: MapReader, parameters: str) -> Plan:
    """Return the plan of a query; raise QueryFault."""
    asked = RegionQuery.parse(parameters, reader.levels)
    cells = _cells(asked.bbox, math.ldexp(reader.cell_size, asked.level), reader.max_region_cells)
    weight = _weight(asked, (cells[2] - cells[0]) * (cells[3] - cells[1]), reader.max_running_cells)

    def draw(state: MapState[Any]) -> Iterator[Reply]:
        # Tiles are drawn uncompressed, as tile queries have them; the region is compressed as a whole.
        form = replace(reader.form(asked), compression=None)
        drawing = reader.drawing(state.levels[0], state.epoch, form)
        yield _mosaic(drawing, cells, asked.compression, reader.keys.region)

    boxes = [(asked.level, tile_box(cells))]
    return Plan(weight, lambda: reader.answer(boxes, draw))


def _cells(bbox: Bbox, cell_size: float, limit: int) -> CellBox:
    """Return the cells i0, j0, i1, j1, half-open, of a box in metres; raise QueryFault."""
    xmin, ymin, xmax, ymax = bbox
    about = max((xmax - xmin) / cell_size, 1.0) * max((ymax - ymin) / cell_size, 1.0)
    if not about <= 2 * limit:  # far too many; also catches numbers that overflow
        raise _too_many_cells(f"about {about:,.0f}" if about < 1e15 else "far more", limit)
    try:
        cells = cell_box(bbox, cell_size)
    except ValueError as error:
        raise QueryFault(QueryCode.BAD_BBOX, f"bbox: {error}") from None
    if min(cells) < -INT32 or max(cells) > INT32:
        raise QueryFault(QueryCode.BAD_BBOX, f"bbox: expected cells within int32; found {cells}")
    count = (cells[2] - cells[0]) * (cells[3] - cells[1])
    if count > limit:
        raise _too_many_cells(str(count), limit)
    return cells


def _too_many_cells(found: str, limit: int) -> QueryFault:
    return QueryFault(
        QueryCode.TOO_LARGE,
        f"expected at most {limit} cells (query.max_region_cells); found {found}: ask for a smaller bbox or a coarser "
        "level",
    )


def _weight(asked: RegionQuery, count: int, limit: int) -> int:
    """Return how many running cells a region of ``count`` cells counts for; raise QueryFault (``too_large``).

    Its layers are in memory three times: drawn, as a message, and on the way out.
    """
    each = -(-3 * len(asked.layers) * np.dtype(asked.dtype).itemsize // CELL_BYTES)
    if each > 1 and count * each > limit:
        raise QueryFault(
            QueryCode.TOO_LARGE,
            f"expected at most {limit} running cells (query.max_running_cells); found {count * each}, for {count} "
            f"cells of {len(asked.layers)} layers as {asked.dtype}: ask for fewer layers, f4, or a smaller bbox",
        )
    return count * each


def _mosaic(drawing: Drawing, cells: CellBox, compression: Compression, key: str) -> Reply:
    """Draw one Grid over the cells i0, j0, i1, j1, half-open, from the tiles that they touch.

    Its stamps and its sequence are those of these tiles; ``drawing`` must draw them uncompressed.
    """
    frozen, form, served = drawing.frozen, drawing.form, drawing.served
    i0, j0, i1, j1 = cells
    x0, y0, x1, y1 = tile_box(cells)
    inside = (frozen.tiles >= (x0, y0)).all(axis=1) & (frozen.tiles <= (x1, y1)).all(axis=1)
    tiles, sequences = frozen.tiles[inside].tolist(), frozen.sequences[inside].tolist()
    packed = np.empty((j1 - j0, i1 - i0, len(form.layers)), np.dtype(f"<{form.dtype}"))
    if len(tiles) < (x1 - x0 + 1) * (y1 - y0 + 1):
        blank = [unknown_value(name) for name in form.layers]
        # Ten times as fast as packed[:] = blank.
        packed.reshape(j1 - j0, -1)[:] = np.tile(np.array(blank, packed.dtype), i1 - i0)
    known_cells, stamps = 0, []
    along_x = {x: overlap(x, i0, i1) for x in range(x0, x1 + 1)}
    along_y = {y: overlap(y, j0, j1) for y in range(y0, y1 + 1)}
    for (x, y), sequence in zip(tiles, sequences, strict=True):  # one at a time: see `_weight`
        tile = drawing.tile(x, y, sequence)
        (across, columns), (up, rows) = along_x[x], along_y[y]
        packed[up, across] = tile.values[rows, columns]
        known_cells += tile.known_among(rows, columns)
        stamps.append((tile.info.oldest_ns, tile.info.newest_ns))
    info = TileInfo(
        map=served.map,
        instance=served.instance,
        epoch=drawing.epoch,
        z=frozen.level,
        x=None,
        y=None,
        sequence=max(sequences, default=0),
        map_sequence=frozen.sequence,
        answer_tiles=1,
        oldest_ns=min((oldest for oldest, _ in stamps), default=0),
        newest_ns=max((newest for _, newest in stamps), default=0),
        known_cells=known_cells,
        digest=None,
        configuration_digest=served.configuration_digest,
        compression=compression,
        surface=served.surface,
    )
    payload = encode_packed(
        form.layers,
        packed,
        (i0 * frozen.cell_size, j0 * frozen.cell_size),
        frozen.cell_size,
        info.newest_ns,
        served.frame_id,
        compression=compression,
    )
    return Reply(key, payload, GRID, model_bytes(info))
