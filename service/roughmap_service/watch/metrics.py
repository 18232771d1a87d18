"""Prometheus metrics, made at each scrape from the status and the counters that the status is made from."""

import platform
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TypeVar

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, InfoMetricFamily
from prometheus_client.exposition import generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from roughmap_schemas.messages import MapStatus
from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, Refusal
from roughmap_service.host.counters import BOUNDS, Counters, Durations
from roughmap_service.watch.readiness import Problem, is_ready

R = TypeVar("R", bound=StrEnum)

DISK_SECONDS = 10.0
"""The sizes of log and store are looked up at most so often: a log may have thousands of files."""


@dataclass(frozen=True, slots=True)
class Depths:
    """What waits where, and what else only the parts of the running service know."""

    intake_bytes: int = 0
    inbox_bytes: int = 0
    log_bytes: int = 0
    queries_waiting: int = 0
    snapshot_sequence: int = 0
    snapshot_ok: bool = True
    memory_taken: int = 0


class Disk:
    """Bytes of the log's files, the store's and the spill file, and room beside them."""

    def __init__(self, log: Path, store: Path | None, spill: Path | None = None) -> None:
        self._log = log
        self._store = store
        self._spill = spill
        self._looked = float("-inf")
        self._sizes: dict[str, tuple[int, int]] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Of "log" and, where there are any, "store" and "spill": (bytes held, bytes free on its disk), as of the last
        seconds."""
        now = time.monotonic()
        if now - self._looked >= DISK_SECONDS:
            self._looked = now
            self._sizes = {"log": (_total(self._log.glob("*.mcap*")), _free(self._log))}
            if self._store is not None:
                parts = self._store.parent.glob(f"{self._store.name}*")
                self._sizes["store"] = (_total(parts), _free(self._store.parent))
            if self._spill is not None:
                blocks = self._spill.stat().st_blocks * 512 if self._spill.exists() else 0  # its length has holes
                self._sizes["spill"] = (blocks, _free(self._spill.parent))
        return self._sizes


def _total(paths: Iterable[Path]) -> int:
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size
        except OSError:
            continue  # deleted meanwhile
    return total


def _free(directory: Path) -> int:
    try:
        return shutil.disk_usage(directory).free
    except OSError:
        return 0


class Metrics(Collector):
    """All metrics of one service; ``problems`` are those of its readiness."""

    def __init__(
        self,
        status: Callable[[], MapStatus],
        counters: Counters,
        depths: Callable[[], Depths],
        problems: Callable[[], Mapping[Problem, str]],
        disk: Disk,
        memory_limit: int,
    ) -> None:
        self._status = status
        self._counters = counters
        self._depths = depths
        self._problems = problems
        self._disk = disk
        self._memory_limit = memory_limit
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """All of them in Prometheus' text form; waits for the rest of one scan's integration at most."""
        return generate_latest(self._registry)

    def describe(self) -> Iterable[Metric]:
        """Nothing: what is registered need not be made for that."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Every family, from one status and one copy of the counters."""
        status, counts, depths = self._status(), self._counters.snapshot(), self._depths()
        build = {"version": status.version, "python": platform.python_version()}
        yield InfoMetricFamily("roughmap_build", "What runs.", value=build)
        named = {"map": status.map, "frame_id": status.frame_id, "error_model": status.error_model}
        told = {**named, "instance": status.instance, "configuration_digest": status.configuration_digest}
        yield InfoMetricFamily("roughmap_map", "The map that is kept.", value=told)
        yield from self._inputs(status)
        yield _durations("lag", "From a cloud's arrival until queries see it.", {"": counts.lag})
        yield _durations("integration", "Placing a cloud and adding it to the map.", {"": counts.integration})
        yield _durations("log_sync", "Bringing the log to the disk (fsync).", {"": counts.log_sync})
        yield _durations("query", "Answering tile, region and cells queries.", counts.queries, "outcome")
        yield _counter(
            "outputs_dropped", "Records of answers and updates that found no room on their way to the log.", "kind",
            {"queries": 0, "updates": 0} | counts.outputs_dropped,
        )  # fmt: skip
        yield from self._state(status)
        yield _gauge(
            "queue_bytes", "What waits: messages to be numbered, clouds for poses, records for the disk.", "queue",
            {"intake": depths.intake_bytes, "inbox": depths.inbox_bytes, "log": depths.log_bytes},
        )  # fmt: skip
        yield _gauge(
            "memory_counted_bytes", "What of the memory counts against map.memory_limit.", value=depths.memory_taken
        )
        yield _gauge("queries_waiting", "Queries that wait for a worker.", value=depths.queries_waiting)
        yield _gauge("snapshot_sequence", "The map's sequence in the store.", value=depths.snapshot_sequence)
        yield _gauge("snapshot_ok", "1 unless the last snapshot failed.", value=depths.snapshot_ok)
        sizes = self._disk.sizes()
        yield _gauge(
            "disk_bytes", "Bytes that the log files, the store and the spill file take.", "what", _part(sizes, 0)
        )
        yield _gauge("disk_free_bytes", "Room on the disk that holds them.", "what", _part(sizes, 1))

    def _inputs(self, status: MapStatus) -> Iterator[Metric]:
        clouds, points, poses = status.clouds, status.points, status.poses
        yield _counter("clouds_accepted", "Clouds integrated.", value=clouds.accepted)
        yield _counter("clouds_rejected", "Clouds that changed nothing.", "reason", _all(CloudReason, clouds.rejected))
        yield _gauge("clouds_waiting", "Clouds without a decision.", value=clouds.waiting)
        yield _counter("points_accepted", "Points that reached a cell.", value=points.accepted)
        yield _counter("points_rejected", "Points that did not.", "reason", _all(PointReason, points.rejected))
        yield _counter("poses_accepted", "Poses taken up.", value=poses.accepted)
        yield _counter("poses_rejected", "Logged poses that were not.", "reason", _all(PoseReason, poses.rejected))
        refused = _all(Refusal, status.refused)
        yield _counter("messages_refused", "Messages that never reached the log.", "reason", refused)
        # Robots are bounded where they are counted, see `counters.OTHERS`.
        yield _counter("messages_missing", "Messages lost on the way here (gaps).", "robot", status.gaps)
        yield _counter("transform_jumps", "Jumps of a robot's frame transform.", "robot", status.jumps)

    def _state(self, status: MapStatus) -> Iterator[Metric]:
        problems = self._problems()
        yield _gauge("ready", "1 if it takes in and answers, as /readyz says.", value=is_ready(problems))
        present = {str(problem): problem in problems for problem in Problem}
        yield _gauge("problem", "1 for each that it suffers from.", "problem", present)
        health = {state: status.health == state for state in ("ok", "overloaded", "degraded")}
        yield _gauge("health", "1 for the one that holds.", "state", health)
        yield _gauge("log_ok", "1 unless the log can't be written.", value=status.log.ok)
        yield _gauge("log_file_bytes", "Bytes of the log file that is being written.", value=status.log.bytes)
        yield _gauge("sequence", "The map's version.", value=status.sequence)
        yield _gauge("durable_sequence", "The version that the log holds on the disk.", value=status.durable_sequence)
        yield _gauge("epoch", "+1 at every start and reset.", value=status.epoch)
        yield _gauge("input", "The log's number of the last message.", value=status.input)
        yield _gauge("newest_stamp_seconds", "Stamp of the map's newest point.", value=status.newest_stamp_ns / 1e9)
        tiles = {"resident": status.tiles.resident, "spilled": status.tiles.spilled}
        yield _gauge("tiles", "Level-0 tiles in memory and in the spill file.", "where", tiles)
        yield _gauge("memory_bytes", "The process's resident memory.", value=status.memory_bytes)
        yield _gauge("memory_limit_bytes", "map.memory_limit.", value=self._memory_limit)
        yield _gauge("uptime_seconds", "Since this start.", value=status.uptime_s)


def _all(reasons: type[R], counts: Mapping[R, int]) -> dict[str, float]:
    """Every reason of an enumeration, so that a rate has its zero to start from."""
    return {str(reason): counts.get(reason, 0) for reason in reasons}


def _part(sizes: Mapping[str, tuple[int, int]], part: int) -> dict[str, float]:
    return {what: pair[part] for what, pair in sizes.items()}


def _counter(
    name: str, text: str, label: str = "", values: Mapping[str, float] | None = None, *, value: float = 0
) -> CounterMetricFamily:
    if not label:
        return CounterMetricFamily(f"roughmap_{name}", text, value=value)
    family = CounterMetricFamily(f"roughmap_{name}", text, labels=[label])
    for key, number in (values or {}).items():
        family.add_metric([key], number)
    return family


def _gauge(
    name: str, text: str, label: str = "", values: Mapping[str, float] | None = None, *, value: float = 0
) -> GaugeMetricFamily:
    if not label:
        return GaugeMetricFamily(f"roughmap_{name}", text, value=value)
    family = GaugeMetricFamily(f"roughmap_{name}", text, labels=[label])
    for key, number in (values or {}).items():
        family.add_metric([key], number)
    return family


def _durations(name: str, text: str, found: Mapping[str, Durations], label: str = "") -> HistogramMetricFamily:
    family = HistogramMetricFamily(f"roughmap_{name}_seconds", text, labels=[label] if label else [])
    for key, durations in found.items():
        buckets, below = [], 0
        for bound, number in zip([*map(str, BOUNDS), "+Inf"], durations.counts, strict=True):
            below += number
            buckets.append((bound, float(below)))
        family.add_metric([key] if label else [], buckets, durations.total)
    return family
