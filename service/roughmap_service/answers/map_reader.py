"""One state of the map, read for a query or an update."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from roughmap.reading.frozen import FrozenMap
from roughmap.reading.region import MAX_CELLS
from roughmap.tiles.index import TileBox
from roughmap_schemas.config import Config
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.keys import Keys
from roughmap_schemas.layers import fault_of_limit, layers_of
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import LayersQuery, RegionQuery, TileQuery
from roughmap_service.answers.drawing import Drawing, NotDrawnYet, TileForm, TileList
from roughmap_service.answers.emptied_tiles import EmptiedHistory, EmptiedTiles
from roughmap_service.answers.plan import Answer, Reply
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.tile_cache import TileCache
from roughmap_service.run.settings import CACHE_SHARE
from roughmap_service.run.view import View

LevelBox = tuple[int, TileBox | None]
"""A level and a box of its tiles; None: all tiles."""

Level = TypeVar("Level", FrozenMap, TileList)


@dataclass(frozen=True, slots=True)
class MapState(Generic[Level]):
    """One state of the map: the tiles of each box, in order, and the tiles that were emptied before or since."""

    levels: list[Level]
    epoch: int
    sequence: int
    emptied: EmptiedTiles


class MapReader:
    """Reads states of one map; holds the settings that plans need, and the cache of tiles that all readers share."""

    def __init__(self, view: View, keys: Keys, config: Config, served: ServedMap, emptied: EmptiedHistory) -> None:
        self.view = view
        self.keys = keys
        self.served = served
        self.levels = config.map.levels
        self.cell_size = config.map.cell_size
        self.tolerance = config.map.height_tolerance
        self.limits = dict(config.map.limits)
        self.max_reply_tiles = config.query.max_reply_tiles
        self.max_running_cells = config.query.max_running_cells
        self.max_region_cells = min(config.query.max_region_cells, MAX_CELLS)
        self.emptied = emptied
        # With a small map.memory_limit, most of it must be left for the tiles themselves.
        self._cache = TileCache(min(config.query.cache_limit, int(config.map.memory_limit * CACHE_SHARE)))

    def limits_of(self, asked: LayersQuery) -> dict[str, float]:
        """Return the limits of a query, or the map's.

        QueryFault for layers and limits that a map of this surface does not have.
        """
        for name in asked.layers:
            if name not in layers_of(self.served.surface):
                raise QueryFault(
                    QueryCode.UNKNOWN_LAYER,
                    f"layers: {name!r} needs a map of the ground (map.surface); this is one of all points",
                )
        if asked.limits is None:
            return self.limits
        for name, value in asked.limits.items():
            if (fault := fault_of_limit(name, value, self.served.surface)) is not None:
                raise QueryFault(QueryCode.BAD_PARAMETER, f"limits: {fault}")
        return {**(self.limits if self.served.surface == "ground" else {}), **asked.limits}

    def form(self, asked: TileQuery | RegionQuery) -> TileForm:
        """Return the form of the tiles that a query asks for; the map's settings stand in for what it leaves open."""
        return TileForm(
            layers=asked.layers,
            tolerance=self.tolerance if asked.tolerance is None else asked.tolerance,
            limits=self.limits_of(asked),
            dtype=asked.dtype,
            compression=asked.compression,
        )

    def drawing(self, tiles: FrozenMap | TileList, epoch: int, form: TileForm) -> Drawing:
        """Return a drawing that shares this reader's cache."""
        return Drawing(tiles, epoch, form, self.served, self._cache)

    @contextmanager
    def answer(self, boxes: Sequence[LevelBox], draw: Callable[[MapState[Any]], Iterator[Reply]]) -> Iterator[Answer]:
        """Open the answer that ``draw`` makes from one state of the map.

        If the cache holds all of its tiles, nothing of the map is held. While a scan is being integrated, such an
        answer shows the map before the scan; any other answer waits for the scan's end.
        """
        self.view.will_read()
        listed = self._listed(boxes)
        try:
            cached = list(draw(listed))
        except NotDrawnYet:
            cached = None
        if cached is not None:
            yield Answer(listed.sequence, cached)
            return
        with self.frozen(boxes) as state:
            yield Answer(state.sequence, draw(state))

    @contextmanager
    def frozen(self, boxes: Sequence[LevelBox]) -> Iterator[MapState[FrozenMap]]:
        """Freeze all boxes in one state of the map, which may change meanwhile."""
        held: list[FrozenMap] = []
        try:
            with self.view.reading() as rough_map:
                held.extend(rough_map.freeze(level, box) for level, box in boxes)
                state = MapState(held, self.view.epoch, rough_map.sequence, self.emptied.now)
            yield state
        finally:
            for one in held:
                self.view.let_go(one)

    def _listed(self, boxes: Sequence[LevelBox]) -> MapState[TileList]:
        """List the tiles of the boxes without their cells. During a change this is the map before it."""
        standing = self.view.standing
        if standing is not None:
            epoch, sequence, updated = standing.epoch, standing.sequence, standing.newest_updated
            found = [standing.levels[level].select(box) for level, box in boxes]
        else:
            with self.view.reading() as rough_map:
                epoch, sequence, updated = self.view.epoch, rough_map.sequence, rough_map.newest_updated
                found = [rough_map.tile_sequences(level, box) for level, box in boxes]
        listed = [
            TileList(level, math.ldexp(self.cell_size, level), sequence, updated, tiles, sequences)
            for (level, _), (tiles, sequences) in zip(boxes, found, strict=True)
        ]
        return MapState(listed, epoch, sequence, self.emptied.now)
