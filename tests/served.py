"""A map and its queryables on real sessions of one process, for tests of answers and of the client."""

import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh
from net import open_pair, wait_for

from roughmap import RoughMap
from roughmap.tiles.index import TileBox
from roughmap_schemas.config import Config, configuration_digest
from roughmap_schemas.keys import Keys
from roughmap_schemas.messages import MapStatus, QueryRecord
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.queryables import Answers
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.answers.updates import RecordUpdate, Updates
from roughmap_service.host.counters import Counters
from roughmap_service.run.view import View
from roughmap_service.watch.status import RunProgress, Status

T0 = 1_700_000_000 * 10**9
INSTANCE = "0123456789abcdef" * 2
RUN = "fedcba9876543210" * 2
S = np.diag([0.02, 0.02, 0.02]) ** 2
"""Covariance of all points here: with coverage 2 an error body of 8 cm, which crosses cells and tiles."""


def some_points(number: int = 1500, seed: int = 7, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return points (number, 3) on rough ground within 8 m of a place; at the origin, in tiles -2 to 1 on both axes."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-8.0, 8.0, (2, number))
    z = 0.3 * np.sin(x) + 0.1 * y + rng.normal(0.0, 0.02, number)
    return np.column_stack((x + centre[0], y + centre[1], z))


def filled(config: Config) -> RoughMap:
    """Five scans, each in another place, so that tiles differ in sequence and stamps."""
    rough_map = RoughMap(
        cell_size=config.map.cell_size, error_model=config.map.error_model, levels=config.map.levels, threads=1,
        surface=config.map.surface,
    )  # fmt: skip
    for number, centre in enumerate([(0.0, 0.0), (12.0, 0.0), (-40.0, 7.0), (12.0, 12.0), (0.0, -12.0)]):
        rough_map.add(some_points(1500, number, centre), S, T0 + number * 10**9)
    return rough_map


@dataclass
class Served:
    """A filled map that `server` answers for; `asker` is a session joined to it over loopback.

    `settings` are sections of the configuration; the map is one of all points unless they say otherwise. `actions` are
    what `control` carries out.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    actions: Mapping[str, Callable[[], tuple[int, int]]] | None = None
    sessions: tuple[zenoh.Session, zenoh.Session] | None = None
    instance: str = INSTANCE
    epoch: int = 5
    status: Callable[[], MapStatus] | None = None

    def __post_init__(self) -> None:
        own = {"name": "site", "surface": "all", **self.settings.get("map", {})}
        self.config = Config.model_validate({**self.settings, "map": own})
        self.map = filled(self.config)
        self.view = View(self.map, self.epoch)
        self.keys = Keys(self.config.map.name, self.config.keys)
        self.emptied = EmptiedHistory(self.config.map.max_tiles)
        self.counters = Counters()
        self.progress = RunProgress()
        self.digest = configuration_digest(self.config)
        self.served_map = ServedMap(
            self.config.map.name, RUN, self.instance, self.digest, self.config.map.frame_id, self.config.map.surface
        )  # fmt: skip
        self.records: list[QueryRecord] = []
        self.recorded = threading.Condition()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self.server, self.asker = self.sessions or self._stack.enter_context(open_pair())
        self._stack.callback(self.map.close)
        self._stack.callback(self.view.wake)
        self.reader = MapReader(self.view, self.keys, self.config, self.served_map, self.emptied)
        actions = self.actions or {"reset": self.reset}
        if self.status is None:
            self.status = Status(
                self.view, self.counters, self.config, self.served_map, "9.8.7", lambda: self.progress
            )  # fmt: skip
        self.answers = self._stack.enter_context(
            Answers(
                self.server, self.reader, self.config.query, status=self.status, control=actions,
                forget=self.forget, record_query=self._record,
            )
        )  # fmt: skip
        self._wait_known(self.keys.control("forget"))
        return self

    def _wait_known(self, key: str) -> None:
        """Wait until the asker knows a queryable. It then knows all that were declared before, too."""
        known = threading.Event()
        querier = self.asker.declare_querier(key)
        listener = querier.declare_matching_listener(lambda status: known.set() if status.matching else None)
        if getattr(querier.matching_status, "matching", querier.matching_status):
            known.set()
        wait_for(known, f"the asker to hear of {key}")
        listener.undeclare()
        querier.undeclare()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _record(self, record: QueryRecord) -> None:
        with self.recorded:
            self.records.append(record)
            self.recorded.notify_all()

    def add(self, points: np.ndarray, stamp_ns: int = T0 + 100 * 10**9) -> int:
        """Add a scan; return the map's new sequence."""
        with self.view.change() as rough_map:
            rough_map.add(points, S, stamp_ns)
            return rough_map.sequence

    def updates(self, record: RecordUpdate = lambda *_: None, session: zenoh.Session | None = None) -> Updates:
        """The updates of this map, to be entered."""
        return Updates(session or self.server, self.reader, self.config, record)

    def reset(self) -> tuple[int, int]:
        """Reset the map as the sequencer does."""
        with self.view.change() as rough_map:
            self.emptied.note(rough_map.tile_sequences()[0], rough_map.sequence + 1)
            rough_map.reset()
            self.view.epoch += 1
            return rough_map.sequence, self.view.epoch

    def forget(self, box: TileBox | None, older: float | None, why: str) -> tuple[int, int, int]:
        """Forget the tiles in a box, as the sequencer does."""
        with self.view.change() as rough_map:
            tiles = rough_map.tile_sequences(0, box)[0]
            rough_map.forget(tiles)
            self.emptied.note(tiles, rough_map.sequence)
            return rough_map.sequence, self.view.epoch, len(tiles)
