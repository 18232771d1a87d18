"""What a query asks for, checked and sized before anything is read, and then read from one frozen map.

Nothing here knows Zenoh: a plan is made from key, parameters and payload, and hands its replies to a callable.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap.cell import TILE_CELLS
from roughmap.frozen import Frozen
from roughmap.region import MAX_CELLS, CellBox, cell_box, tile_box
from roughmap_schemas.config import Config
from roughmap_schemas.encodings import GRID
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.keys import Keys, Selected
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import Bbox, RegionQuery, TileQuery
from roughmap_service.emptied import Emptied, Gone
from roughmap_service.tile_cache import TileCache
from roughmap_service.tile_reply import TILE_LIMIT, Drawing, Identity, Wanted, region_reply, tile_range, tile_reply
from roughmap_service.view import View

TILE_AREA = TILE_CELLS * TILE_CELLS
INT32 = 2**31

Box = tuple[int, int, int, int]


class Send(Protocol):
    """Sends one reply: key, payload, encoding, attachment."""

    def __call__(self, key: str, payload: bytes, encoding: str, attachment: bytes | None = None) -> None: ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was answered: replies, and the map's sequence that they show."""

    tiles: int
    sequence: int


@dataclass(frozen=True, slots=True)
class Plan:
    """A checked query: how many cells it may read at most, and the reading itself, which may still raise QueryFault,
    but only before its first reply."""

    cells: int
    answer: Callable[[Send], Outcome]


class Reader:
    """Makes plans over one map."""

    def __init__(self, view: View, keys: Keys, config: Config, identity: Identity, emptied: Emptied) -> None:
        self.view = view
        self.keys = keys
        self.identity = identity
        self.levels = config.map.levels
        self.cell_size = config.map.cell_size
        self.tolerance = config.map.height_tolerance
        self.limits = dict(config.map.limits)
        self.max_reply_tiles = config.query.max_reply_tiles
        self.max_region_cells = min(config.query.max_region_cells, MAX_CELLS)
        self._emptied = emptied
        self._cache = TileCache(config.query.cache_limit)

    def wanted(self, look: TileQuery | RegionQuery) -> Wanted:
        """What is asked of each cell, the map's settings in place of what was left open."""
        return Wanted(
            layers=look.layers,
            tolerance=self.tolerance if look.tolerance is None else look.tolerance,
            limits=self.limits if look.limits is None else look.limits,
            dtype=look.dtype,
            compression=look.compression,
        )

    @contextmanager
    def frozen(self, boxes: list[tuple[int, Box | None]]) -> Iterator[tuple[list[Frozen], int, int, Gone]]:
        """Several (level, box) of one and the same map, its epoch and sequence, and what resets had emptied by then."""
        held: list[Frozen] = []
        try:
            with self.view.reading() as rough_map:
                held.extend(rough_map.freeze(level, box) for level, box in boxes)
                epoch, sequence, gone = self.view.epoch, rough_map.sequence, self._emptied.now
            yield held, epoch, sequence, gone
        finally:
            with self.view.reading():
                for one in held:
                    one.close()

    # Tiles ----------------------------------------------------------------------------------------------------------

    def tiles(self, key: str, parameters: str) -> Plan:
        """A query of ``maps/{map}/tiles/...``."""
        asked = TileQuery.parse(parameters)
        (level, x, y), pattern = self._selected(key)
        boxes: list[tuple[int, Box | None]] = []
        count = 0
        for z in range(self.levels) if level is None else (level,):
            box = _tile_box(x, y, asked.bbox, math.ldexp(self.cell_size, z))
            known = self.view.map.tile_count
            if box is None:
                count += known
            elif box[0] <= box[2] and box[1] <= box[3]:
                count += min(known, (box[2] - box[0] + 1) * (box[3] - box[1] + 1))
            else:
                continue
            boxes.append((z, box))
        cells = min(count, self.max_reply_tiles) * TILE_AREA
        return Plan(cells, lambda send: self._answer_tiles(asked, boxes, pattern, send))

    def _selected(self, key: str) -> tuple[Selected, zenoh.KeyExpr | None]:
        """Level, x and y (None: any); for key expressions of another form than numbers and `*` the expression itself,
        which the tiles' keys must intersect."""
        form = self.keys.form("tiles")
        parts = key.split("/")
        if len(parts) == len(form.chunks) and "**" not in parts:
            # Zenoh brought the query here, so its other chunks match: what counts is in the numbers' places.
            parts = [part if chunk.startswith("{") else chunk for chunk, part in zip(form.chunks, parts, strict=True)]
            # A chunk such as 1$* takes any number at first; what else stands there must be one.
            whole = ["*" if "$*" in part else part for part in parts]
            selected = self.keys.parse_tile_selector("/".join(whole), self.levels)
            return selected, zenoh.KeyExpr(key) if whole != parts else None
        if "**" not in parts:
            return self.keys.parse_tile_selector(key, self.levels), None  # raises: no tile has such a key
        return (None, None, None), zenoh.KeyExpr(key)

    def _answer_tiles(
        self, asked: TileQuery, boxes: list[tuple[int, Box | None]], pattern: zenoh.KeyExpr | None, send: Send
    ) -> Outcome:
        wanted = self.wanted(asked)
        with self.frozen(boxes) as (levels, epoch, sequence, gone):
            same_epoch = asked.since is not None and asked.epoch == epoch
            if same_epoch and asked.since is not None and asked.since > sequence:
                raise QueryFault(
                    QueryCode.SINCE_AHEAD, f"since: the map is at sequence {sequence}; found {asked.since}"
                )
            chosen: list[tuple[Drawing, int, int, int]] = []
            for (level, box), frozen in zip(boxes, levels, strict=True):
                drawing = Drawing(frozen, epoch, wanted, self.identity.frame_id, self._cache)
                tiles, sequences = frozen.tiles, frozen.sequences
                if same_epoch and asked.since is not None:
                    newer = sequences > asked.since
                    tiles, sequences = tiles[newer], sequences[newer]
                chosen.extend((drawing, x, y, s) for (x, y), s in zip(tiles.tolist(), sequences.tolist(), strict=True))
                if asked.since is not None and not same_epoch:
                    emptied = _within(gone.tiles(level, frozen.tiles), box)
                    chosen.extend((drawing, x, y, gone.sequence) for x, y in emptied.tolist())
            if pattern is not None:
                chosen = [c for c in chosen if pattern.intersects(self.keys.tile(c[0].frozen.level, c[1], c[2]))]
            if len(chosen) > self.max_reply_tiles:
                raise QueryFault(
                    QueryCode.TOO_LARGE,
                    f"{len(chosen)} tiles; expected at most {self.max_reply_tiles} (query.max_reply_tiles): ask for a "
                    "smaller bbox or a coarser level",
                )
            for drawing, x, y, tile_sequence in chosen:
                reply = tile_reply(drawing, x, y, tile_sequence, self.identity, len(chosen))
                send(self.keys.tile(drawing.frozen.level, x, y), reply.payload, GRID, reply.attachment)
            return Outcome(len(chosen), sequence)

    # Region ---------------------------------------------------------------------------------------------------------

    def region(self, parameters: str) -> Plan:
        """A query of ``maps/{map}/region``."""
        asked = RegionQuery.parse(parameters, self.levels)
        cells = self._cells(asked.bbox, math.ldexp(self.cell_size, asked.level))
        count = (cells[2] - cells[0]) * (cells[3] - cells[1])
        return Plan(count, lambda send: self._answer_region(asked, cells, send))

    def _cells(self, bbox: Bbox, cell_size: float) -> CellBox:
        """The cells of a box; ``too_large`` or ``bad_bbox``."""
        xmin, ymin, xmax, ymax = bbox
        about = max((xmax - xmin) / cell_size, 1.0) * max((ymax - ymin) / cell_size, 1.0)
        if not about <= 2 * self.max_region_cells:  # far too many: also where the numbers overflow
            raise self._too_many_cells(f"some {about:.3g}")
        try:
            cells = cell_box(bbox, cell_size)
        except ValueError as error:
            raise QueryFault(QueryCode.BAD_BBOX, f"bbox: {error}") from None
        if min(cells) < -INT32 or max(cells) > INT32:
            raise QueryFault(QueryCode.BAD_BBOX, f"bbox: expected cells within int32; found {cells}")
        count = (cells[2] - cells[0]) * (cells[3] - cells[1])
        if count > self.max_region_cells:
            raise self._too_many_cells(str(count))
        return cells

    def _too_many_cells(self, count: str) -> QueryFault:
        return QueryFault(
            QueryCode.TOO_LARGE,
            f"{count} cells; expected at most {self.max_region_cells} (query.max_region_cells): ask for a smaller bbox "
            "or a coarser level",
        )

    def _answer_region(self, asked: RegionQuery, cells: CellBox, send: Send) -> Outcome:
        with self.frozen([(asked.level, tile_box(cells))]) as ((frozen,), epoch, sequence, _):
            reply = region_reply(frozen, epoch, cells, self.wanted(asked), self.identity, self._cache)
        send(self.keys.region, reply.payload, GRID, reply.attachment)
        return Outcome(1, sequence)


def _tile_box(x: int | None, y: int | None, bbox: Bbox | None, cell_size: float) -> Box | None:
    """Tiles x0, y0, x1, y1, inclusive, of a key and a bbox together; None for all, x0 > x1 or y0 > y1 for none."""
    if x is None and y is None and bbox is None:
        return None
    x0 = y0 = -TILE_LIMIT
    x1 = y1 = TILE_LIMIT - 1
    if bbox is not None:
        edge = INT32 * cell_size  # no cell lies beyond
        clipped = [min(max(value, -edge), edge) for value in bbox]
        bx0, by0, bx1, by1 = tile_range((clipped[0], clipped[1], clipped[2], clipped[3]), cell_size)
        x0, y0, x1, y1 = max(x0, bx0), max(y0, by0), min(x1, bx1), min(y1, by1)
    if x is not None:
        x0, x1 = max(x0, x), min(x1, x)
    if y is not None:
        y0, y1 = max(y0, y), min(y1, y)
    return x0, y0, x1, y1


def _within(tiles: npt.NDArray[np.int32], box: Box | None) -> npt.NDArray[np.int32]:
    if box is None or not len(tiles):
        return tiles
    inside = (tiles >= np.array(box[:2])).all(axis=1) & (tiles <= np.array(box[2:])).all(axis=1)
    return tiles[inside]
