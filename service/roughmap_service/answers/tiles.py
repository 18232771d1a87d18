"""What a query asks for, checked and sized before anything is read, and then read from one frozen map.

Nothing here knows Zenoh: a plan is made from key, parameters and payload, and hands its replies to a callable.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import zenoh

from roughmap.cell import TILE_CELLS
from roughmap.reading.frozen import FrozenMap
from roughmap.reading.region import MAX_CELLS, CellBox, cell_box, tile_box
from roughmap.tiles.index import TILE_LIMIT, TileBox
from roughmap_schemas.config import Config
from roughmap_schemas.encodings import GRID
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.keys import Keys, Selected
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import Bbox, RegionQuery, TileQuery
from roughmap_service.answers.emptied import Emptied, Gone
from roughmap_service.answers.tile_cache import TileCache
from roughmap_service.answers.tile_reply import (
    Drawable,
    Drawing,
    Identity,
    NotDrawnYet,
    TileReply,
    Wanted,
    region_reply,
    tile_range,
)
from roughmap_service.run.settings import CACHE_SHARE
from roughmap_service.run.view import View

TILE_AREA = TILE_CELLS * TILE_CELLS
INT32 = 2**31

KNOWN_SELECTORS, SHORT_SELECTOR = 256, 512
"""Selectors that are kept as read, and how long those are at most."""

LevelBox = tuple[int, TileBox | None]
"""A level, and the tiles of it that are meant; None: all."""

Reply = tuple[str, TileReply]
"""A reply and the key that it goes under."""

State = TypeVar("State", FrozenMap, Drawable)


class Send(Protocol):
    """Sends one reply: key, payload, encoding, attachment."""

    def __call__(self, key: str, payload: bytes, encoding: str, attachment: bytes | None = None) -> None: ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was answered: replies, and the map's sequence that they show."""

    tiles: int
    sequence: int


@dataclass(frozen=True, slots=True)
class Cut(Generic[State]):
    """One state of the map: of each box asked for its tiles, and what resets had emptied by then (None: not known)."""

    levels: list[State]
    epoch: int
    sequence: int
    gone: Gone | None


@dataclass(frozen=True, slots=True)
class Plan:
    """A checked query: how many cells it may read at most, and the reading itself, which may still raise QueryFault,
    but only before its first reply."""

    cells: int
    answer: Callable[[Send], Outcome]


CELL_BYTES = 64
"""What a running cell may take of memory; as much as its record does."""


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
        self.max_running_cells = config.query.max_running_cells
        self.max_region_cells = min(config.query.max_region_cells, MAX_CELLS)
        self._emptied = emptied
        # Who asks for tiles asks the same over and over, and to read what it is takes as long as to answer it.
        self._known_tile_query = lru_cache(KNOWN_SELECTORS)(self._tile_query)
        # Of a small map.memory_limit most must be left for the tiles themselves.
        self._cache = TileCache(min(config.query.cache_limit, int(config.map.memory_limit * CACHE_SHARE)))

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
    def frozen(self, boxes: Sequence[LevelBox]) -> Iterator[Cut[FrozenMap]]:
        """Several (level, box) of one and the same map, to be read while it goes on."""
        held: list[FrozenMap] = []
        try:
            with self.view.reading() as rough_map:
                held.extend(rough_map.freeze(level, box) for level, box in boxes)
                cut = Cut(held, self.view.epoch, rough_map.sequence, self._emptied.now)
            yield cut
        finally:
            for one in held:
                self.view.let_go(one)

    def _listed(self, boxes: Sequence[LevelBox]) -> Cut[Drawable]:
        """The same without the tiles' cells; while a change is going on, of the map before it (then it isn't known what
        resets had emptied, since the change may be one)."""
        standing = self.view.standing
        if standing is not None:
            epoch, sequence, updated, gone = standing.epoch, standing.sequence, standing.newest_updated, None
            found = [standing.levels[level].select(box) for level, box in boxes]
        else:
            with self.view.reading() as rough_map:
                epoch, sequence, updated = self.view.epoch, rough_map.sequence, rough_map.newest_updated
                found, gone = [rough_map.tile_sequences(level, box) for level, box in boxes], self._emptied.now
        listed = [
            Drawable(level, math.ldexp(self.cell_size, level), sequence, updated, tiles, sequences)
            for (level, _), (tiles, sequences) in zip(boxes, found, strict=True)
        ]
        return Cut(listed, epoch, sequence, gone)

    def _answer(self, boxes: Sequence[LevelBox], replies: Callable[[Cut[Any]], Iterator[Reply]], send: Send) -> Outcome:
        """Send what ``replies`` makes of one state of the map.

        Where all tiles were drawn already, nothing of the map need be held. While a scan is being integrated such an
        answer is of the map before it; any other waits for the scan's end.
        """
        self.view.will_read()
        cut = self._listed(boxes)
        try:
            made = list(replies(cut))
        except NotDrawnYet:
            with self.frozen(boxes) as held:
                return _sent(replies(held), held.sequence, send)
        return _sent(made, cut.sequence, send)

    # Tiles ----------------------------------------------------------------------------------------------------------

    def tiles(self, key: str, parameters: str) -> Plan:
        """A query of ``maps/{map}/tiles/...``."""
        short = len(key) + len(parameters) <= SHORT_SELECTOR
        asked, (level, x, y), pattern = (self._known_tile_query if short else self._tile_query)(key, parameters)
        boxes: list[LevelBox] = []
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
        return Plan(
            cells, lambda send: self._answer(boxes, lambda cut: self._tile_replies(asked, boxes, pattern, cut), send)
        )

    def _tile_query(self, key: str, parameters: str) -> tuple[TileQuery, Selected, zenoh.KeyExpr | None]:
        return TileQuery.parse(parameters), *self._selected(key)

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

    def _tile_replies(
        self, asked: TileQuery, boxes: Sequence[LevelBox], pattern: zenoh.KeyExpr | None, cut: Cut[Any]
    ) -> Iterator[Reply]:
        """The replies to a tile query; raises QueryFault before the first."""
        wanted = self.wanted(asked)
        same_epoch = asked.since is not None and asked.epoch == cut.epoch
        if same_epoch and asked.since is not None and asked.since > cut.sequence:
            raise QueryFault(
                QueryCode.SINCE_AHEAD, f"since: the map is at sequence {cut.sequence}; found {asked.since}"
            )
        chosen: list[tuple[Drawing, int, int, int]] = []
        for (level, box), state in zip(boxes, cut.levels, strict=True):
            drawing = Drawing(state, cut.epoch, wanted, self.identity, self._cache)
            tiles, sequences = state.tiles, state.sequences
            if same_epoch and asked.since is not None:
                newer = sequences > asked.since
                tiles, sequences = tiles[newer], sequences[newer]
            chosen.extend((drawing, x, y, s) for (x, y), s in zip(tiles.tolist(), sequences.tolist(), strict=True))
            if asked.since is not None and not same_epoch:
                if cut.gone is None:
                    raise NotDrawnYet
                emptied = _within(cut.gone.tiles(level, state.tiles), box)
                chosen.extend((drawing, x, y, cut.gone.sequence) for x, y in emptied.tolist())
        if pattern is not None:
            chosen = [c for c in chosen if pattern.intersects(self.keys.tile(c[0].frozen.level, c[1], c[2]))]
        if len(chosen) > self.max_reply_tiles:
            raise QueryFault(
                QueryCode.TOO_LARGE,
                f"{len(chosen)} tiles; expected at most {self.max_reply_tiles} (query.max_reply_tiles): ask for a "
                "smaller bbox or a coarser level",
            )
        for drawing, x, y, tile_sequence in chosen:
            yield self.keys.tile(drawing.frozen.level, x, y), drawing.reply(x, y, tile_sequence, len(chosen))

    # Region ---------------------------------------------------------------------------------------------------------

    def region(self, parameters: str) -> Plan:
        """A query of ``maps/{map}/region``."""
        asked = RegionQuery.parse(parameters, self.levels)
        cells = self._cells(asked.bbox, math.ldexp(self.cell_size, asked.level))
        count = (cells[2] - cells[0]) * (cells[3] - cells[1])
        boxes = [(asked.level, tile_box(cells))]
        count = self._weight(count, asked)
        return Plan(count, lambda send: self._answer(boxes, lambda cut: self._region_reply(asked, cells, cut), send))

    def _weight(self, count: int, asked: RegionQuery) -> int:
        """For how many running cells a region's count: its layers are in memory three times, drawn, as a message, and
        on its way out. ``too_large`` for what many layers make more than may run at all."""
        each = -(-3 * len(asked.layers) * np.dtype(asked.dtype).itemsize // CELL_BYTES)
        if each > 1 and count * each > self.max_running_cells:
            raise QueryFault(
                QueryCode.TOO_LARGE,
                f"{count} cells of {len(asked.layers)} layers as {asked.dtype} count for {count * each}; expected at "
                f"most {self.max_running_cells} (query.max_running_cells): ask for fewer layers, f4, or a smaller bbox",
            )
        return count * each

    def _cells(self, bbox: Bbox, cell_size: float) -> CellBox:
        """The cells of a box; ``too_large`` or ``bad_bbox``."""
        xmin, ymin, xmax, ymax = bbox
        about = max((xmax - xmin) / cell_size, 1.0) * max((ymax - ymin) / cell_size, 1.0)
        if not about <= 2 * self.max_region_cells:  # far too many: also where the numbers overflow
            raise self._too_many_cells(f"some {about:,.0f}" if about < 1e15 else "far too many")
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

    def _region_reply(self, asked: RegionQuery, cells: CellBox, cut: Cut[Any]) -> Iterator[Reply]:
        wanted = replace(self.wanted(asked), compression=None)
        drawing = Drawing(cut.levels[0], cut.epoch, wanted, self.identity, self._cache)
        yield self.keys.region, region_reply(drawing, cells, asked.compression)


def _sent(replies: Iterable[Reply], sequence: int, send: Send) -> Outcome:
    number = 0
    for key, reply in replies:
        send(key, reply.payload, GRID, reply.attachment)
        number += 1
    return Outcome(number, sequence)


def _tile_box(x: int | None, y: int | None, bbox: Bbox | None, cell_size: float) -> TileBox | None:
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


def _within(tiles: npt.NDArray[np.int32], box: TileBox | None) -> npt.NDArray[np.int32]:
    if box is None or not len(tiles):
        return tiles
    inside = (tiles >= np.array(box[:2])).all(axis=1) & (tiles <= np.array(box[2:])).all(axis=1)
    return tiles[inside]
