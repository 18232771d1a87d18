"""The status of the service and its map, made on request and published once a second."""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas.config import Config
from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.keys import Keys
from roughmap_schemas.layers import layers_of
from roughmap_schemas.messages import (
    CloudCounts,
    Lag,
    LogState,
    MapStatus,
    PointCounts,
    PoseCounts,
    Rates,
    TileCounts,
    model_bytes,
)
from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, Refusal
from roughmap_service.answers.served_map import ServedMap
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.run.view import View
from roughmap_service.store.memory_limit import memory_bytes
from roughmap_service.watch.readiness import OVERLOADED_TEXT, SUBJECTS, Problem, health_of, told

logger = logging.getLogger(__name__)

PERIOD_SECONDS = 1.0
"""Time between two published statuses; the contract promises 1 Hz."""


@dataclass(frozen=True, slots=True)
class RunProgress:
    """The part of the status that the running parts report, at one moment.

    ``problems`` are the service's, each with its cause; ``lost`` are the sentences on robots and sensors,
    ``recent`` those on what happened to them lately.
    """

    durable_sequence: int = 0
    input: int = 0
    newest_stamp_ns: int = 0
    waiting: int = 0
    problems: Mapping[Problem, str] = field(default_factory=dict)
    lost: Mapping[str, str] = field(default_factory=dict)
    recent: Sequence[str] = ()
    log: LogState = field(default_factory=LogState)


class Status:
    """Makes `MapStatus` from the map, the counters and ``progress``."""

    def __init__(
        self,
        view: View,
        counters: Counters,
        config: Config,
        served: ServedMap,
        version: str,
        progress: Callable[[], RunProgress],
    ) -> None:
        self._view = view
        self._counters = counters
        self._map = config.map
        self._served = served
        self._version = version
        self._progress = progress
        self._started = time.monotonic()

    def __call__(self) -> MapStatus:
        """Return the status now. Waits for the rest of one scan's integration at most."""
        progress = self._progress()  # first: if no cloud waits in it, the map below has all of them
        with self._view.reading() as rough_map:
            epoch, sequence = self._view.epoch, rough_map.sequence
            extent, tiles, resident = rough_map.extent(), rough_map.tile_count, rough_map.resident_tiles
        counts = self._counters.snapshot()
        lag, (clouds, points, poses) = self._counters.lag(), self._counters.rates()
        return MapStatus(
            map=self._served.map,
            run=self._served.run,
            instance=self._served.instance,
            epoch=epoch,
            version=self._version,
            frame_id=self._map.frame_id,
            cell_size=self._map.cell_size,
            levels=self._map.levels,
            layers=list(layers_of(self._map.surface)),
            bounds=self._map.bounds,
            extent=extent,
            error_model=self._map.error_model,
            surface=self._map.surface,
            configuration_digest=self._served.configuration_digest,
            health=health_of(progress.problems),
            sequence=sequence,
            durable_sequence=progress.durable_sequence,
            input=progress.input,
            newest_stamp_ns=progress.newest_stamp_ns,
            clouds=CloudCounts(
                accepted=counts.clouds_accepted,
                waiting=progress.waiting,
                rejected={CloudReason(reason): n for reason, n in counts.clouds_rejected.items()},
            ),
            points=PointCounts(
                accepted=counts.points_accepted,
                rejected={PointReason(reason): n for reason, n in counts.points_rejected.items()},
            ),
            poses=PoseCounts(
                accepted=counts.poses_accepted,
                rejected={PoseReason(reason): n for reason, n in counts.poses_rejected.items()},
            ),
            refused={Refusal(reason): n for reason, n in counts.refused.items()},
            gaps=dict(counts.gaps),
            jumps=dict(counts.jumps),
            problems=told(progress.problems, progress.lost),
            recent=list(progress.recent),
            lag_s=Lag(p50=lag.p50, p99=lag.p99),
            rates=Rates(clouds=clouds, points=points, poses=poses),
            memory_bytes=memory_bytes(),
            tiles=TileCounts(resident=resident, spilled=tiles - resident),
            forgotten=counts.tiles_forgotten,
            log=progress.log,
            uptime_s=time.monotonic() - self._started,
        )


class StatusPublisher:
    """Publishes the status once a second while it is entered."""

    def __init__(self, session: zenoh.Session, keys: Keys, status: Callable[[], MapStatus]) -> None:
        self._session = session
        self._key = keys.status
        self._status = status
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End; wait at most 2 s for a status that is being sent."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _run(self) -> None:
        encoding = json_encoding("MapStatus")
        overload = Overload()
        while not self._closing.is_set():
            try:
                status = self._status()
                overload.watch(status)
                # DROP: the next status replaces a lost one, and a stalled reader must not delay it. DATA_HIGH, like
                # events: nothing blocks in the queue of that priority.
                self._session.put(
                    self._key,
                    model_bytes(status),
                    encoding=encoding,
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.DATA_HIGH,
                )
            except Exception:  # without further statuses the service would seem dead
                if self._session.is_closed():
                    return
                logger.exception("cannot publish the status; trying again in %g s", PERIOD_SECONDS)
            self._closing.wait(PERIOD_SECONDS)


class Overload:
    """Logs when an overload begins and when it ends, with the number of messages it cost."""

    def __init__(self) -> None:
        self._begun = False
        self._before = 0  # messages dropped before the present overload

    def watch(self, status: MapStatus) -> None:
        """Take the next status, in order of time."""
        dropped = status.clouds.rejected.get(CloudReason.OVERLOAD, 0) + status.refused.get(Refusal.BUSY, 0)
        own = status.problems.keys() & SUBJECTS.values()  # what is wrong with the service itself
        if own == {SUBJECTS[Problem.OVERLOADED]} and not self._begun:
            self._begun = True
            text = f"overloaded: {OVERLOADED_TEXT}"
            note(logger, logging.WARNING, "overload_begun", text, always=True, waiting=status.clouds.waiting)
        elif not own:
            if self._begun:
                lost = dropped - self._before
                text = f"no longer overloaded; {lost} messages were dropped or refused"
                note(logger, logging.INFO, "overload_ended", text, always=True, dropped=lost)
            self._begun, self._before = False, dropped
