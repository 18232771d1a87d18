"""A map.db or a log, opened as a map that is only read."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roughmap import RoughMap
from roughmap_schemas import Config
from roughmap_service.exports.cut import Bbox, cells_of, tiles_in
from roughmap_service.exports.sheet import ExportFault, Sheet
from roughmap_service.offline.replay import Watch, replay
from roughmap_service.run.settings import new_map
from roughmap_service.store.map_db import OtherStateVersion, Store
from roughmap_service.store.spill import Spill
from roughmap_service.store.stored_tiles import StoredTiles, set_index

NO_SPILL = 1 << 30
"""Bytes of a spill file that stays empty: a map that is only read moves no tiles there."""


SQLITE, MCAP = b"SQLite format 3\0", b"\x89MCAP"
"""How a store and a log begin."""


class OpenedMap(NamedTuple):
    """A map, the settings that it was made with, its coordinate reference system if known, and words for a title."""

    map: RoughMap
    config: Config
    crs: str | None
    title: str


@contextmanager
def open_map(paths: list[Path], watch: Watch | None = None) -> Iterator[OpenedMap]:
    """Open one map.db, whose tiles stay on the disk until they are read, or replay the logs of one run.

    StoreError, LogError, ReplayError; ExportFault for an empty store or a log that does not replay to the same map.
    """
    for path in paths:
        _check(path, alone=len(paths) == 1)
    if len(paths) == 1 and paths[0].is_file() and paths[0].suffix != ".mcap":
        with _stored(paths[0]) as opened:
            yield opened
        return
    done = replay(paths, watch=watch)
    if done.difference is not None:
        raise ExportFault(f"the log does not replay to the map that was served: it {done.verdict}")
    with done.run.map as built:
        yield OpenedMap(built, done.config, None, f"{done.config.map.name}, sequence {built.sequence}")


def _check(path: Path, *, alone: bool) -> None:
    """Raise ExportFault for what is neither a store nor a log: most likely a recording of which no map was made."""
    if path.is_dir():
        map_less = (path / "metadata.yaml").exists() or not any(path.glob("*.mcap"))
        found = "a folder without roughmap's logs"
    else:
        with path.open("rb") as stream:
            head = stream.read(len(SQLITE))
        map_less = head[: len(MCAP)] != MCAP and head not in (SQLITE, b"")
        found = "neither a map.db nor a log"
        if not alone and not map_less and head[: len(MCAP)] != MCAP:
            raise ExportFault(f"{path}: expected the logs (*.mcap) of one run, or one map.db alone")
    if map_less:
        raise ExportFault(f"{path}: {found}; make a map of a recording first: roughmap build {path} -o map.db")


@contextmanager
def _stored(path: Path) -> Iterator[OpenedMap]:
    store = Store(path)
    try:
        cut = store.read_cut()
    except OtherStateVersion as error:
        raise ExportFault(f"{error}; export the logs of its run, or build it again from its recordings") from None
    if cut is None:
        raise ExportFault(f"{path}: nothing was stored yet")
    config = Config.from_log(cut.configuration)
    with tempfile.TemporaryDirectory() as room, Spill(Path(room) / "tiles.spill", NO_SPILL) as spill:
        stored = StoredTiles(store)
        places = spill.adopt(stored)
        with new_map(config, spill) as rough_map:
            set_index(rough_map, cut, stored, places)
            yield OpenedMap(rough_map, config, store.crs(), f"{config.map.name}, sequence {cut.sequence}")


@contextmanager
def sheet_of(
    opened: OpenedMap,
    layers: tuple[str, ...],
    level: int,
    bbox: Bbox | None,
    crs: str | None,
) -> Iterator[Sheet]:
    """Give the sheet of a level of the map; ExportFault if there is nothing in the box, or no such level."""
    config = opened.config.map
    if level >= config.levels:
        raise ExportFault(f"--level {level}: the map has the levels 0 to {config.levels - 1}")
    with opened.map.freeze(level) as frozen:
        frozen.check(layers, config.height_tolerance, config.limits)
        tiles = frozen.tiles.astype(np.int64)
        cells = cells_of(tiles, frozen.cell_size, bbox)
        chosen = tiles_in(tiles, cells)
        stamp = max((frozen.stamps(x, y)[1] for x, y in chosen.tolist()), default=0)
        yield Sheet(
            layers, cells, frozen.cell_size, chosen,
            lambda x, y: frozen.packed_layers(x, y, layers, config.height_tolerance, config.limits),
            config.frame_id, stamp, crs or opened.crs, opened.title,
        )  # fmt: skip
