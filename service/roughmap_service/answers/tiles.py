"""Queries of ``maps/{map}/tiles/{z}/{x}/{y}``: tiles of any number of levels, one reply each."""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from roughmap_schemas.encodings import GRID
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import TileQuery
from roughmap_service.answers.drawing import Drawing
from roughmap_service.answers.map_reader import LevelBox, MapReader, MapState
from roughmap_service.answers.plan import TILE_AREA, Plan, Reply
from roughmap_service.answers.tile_selection import SelectedKeys, selected_box, selected_keys, within

CACHED_SELECTORS = 256
"""Parsed selectors that are kept."""

CACHED_SELECTOR_LENGTH = 512
"""Characters of the longest selector that is kept."""


class _Chosen(NamedTuple):
    """A tile to reply with."""

    drawing: Drawing
    x: int
    y: int
    sequence: int


class TileQueries:
    """Plans tile queries on one map."""

    def __init__(self, reader: MapReader) -> None:
        self._reader = reader
        # Clients repeat their selectors, and parsing one takes as long as answering it.
        self._parse_cached = lru_cache(CACHED_SELECTORS)(self._parse)

    def plan(self, key: str, parameters: str) -> Plan:
        """Return the plan of a query; raise QueryFault."""
        reader = self._reader
        short = len(key) + len(parameters) <= CACHED_SELECTOR_LENGTH
        asked, selected = (self._parse_cached if short else self._parse)(key, parameters)
        known = reader.view.map.tile_count
        boxes: list[LevelBox] = []
        count = 0
        for level in range(reader.levels) if selected.level is None else (selected.level,):
            box = selected_box(selected.x, selected.y, asked.bbox, math.ldexp(reader.cell_size, level))
            if box is None:
                count += known
            elif box[0] <= box[2] and box[1] <= box[3]:
                count += min(known, (box[2] - box[0] + 1) * (box[3] - box[1] + 1))
            else:
                continue
            boxes.append((level, box))
        cells = min(count, reader.max_reply_tiles) * TILE_AREA
        return Plan(cells, lambda: reader.answer(boxes, lambda state: self._draw(asked, selected, boxes, state)))

    def _parse(self, key: str, parameters: str) -> tuple[TileQuery, SelectedKeys]:
        return TileQuery.parse(parameters), selected_keys(self._reader.keys, self._reader.levels, key)

    def _draw(
        self, asked: TileQuery, selected: SelectedKeys, boxes: Sequence[LevelBox], state: MapState[Any]
    ) -> Iterator[Reply]:
        """Draw the replies from one state of the map; raise QueryFault before the first."""
        keys, limit = self._reader.keys, self._reader.max_reply_tiles
        chosen = self._choose(asked, boxes, state)
        if selected.pattern is not None:
            pattern = selected.pattern
            chosen = [one for one in chosen if pattern.intersects(keys.tile(one.drawing.frozen.level, one.x, one.y))]
        if len(chosen) > limit:
            raise QueryFault(
                QueryCode.TOO_LARGE,
                f"expected at most {limit} tiles (query.max_reply_tiles); found {len(chosen)}: ask for a smaller bbox "
                "or a coarser level",
            )
        for drawing, x, y, sequence in chosen:
            drawn = drawing.tile(x, y, sequence)
            attachment = drawn.attachment(state.sequence, len(chosen))
            yield Reply(keys.tile(drawing.frozen.level, x, y), drawn.payload, GRID, attachment)

    def _choose(self, asked: TileQuery, boxes: Sequence[LevelBox], state: MapState[Any]) -> list[_Chosen]:
        """Return the tiles in the boxes that changed after ``since``.

        If ``since`` is from another epoch, all tiles are new. Those that were emptied since are replied to as well: all
        unknown, with known_cells 0.
        """
        form, since = self._reader.form(asked), asked.since
        same_epoch = asked.epoch == state.epoch
        if since is not None and same_epoch and since > state.sequence:
            raise QueryFault(QueryCode.SINCE_AHEAD, f"since: the map is at sequence {state.sequence}; found {since}")
        chosen: list[_Chosen] = []
        for (level, box), listed in zip(boxes, state.levels, strict=True):
            drawing = self._reader.drawing(listed, state.epoch, form)
            tiles, sequences = listed.tiles, listed.sequences
            if since is not None and same_epoch:
                newer = sequences > since
                tiles, sequences = tiles[newer], sequences[newer]
            pairs = zip(tiles.tolist(), sequences.tolist(), strict=True)
            chosen.extend(_Chosen(drawing, x, y, sequence) for (x, y), sequence in pairs)
            if since is not None:
                gone = within(state.emptied.tiles(level, listed.tiles, since if same_epoch else -1), box)
                sequence = min(state.emptied.sequence, state.sequence)
                chosen.extend(_Chosen(drawing, x, y, sequence) for x, y in gone.tolist())
        return chosen
