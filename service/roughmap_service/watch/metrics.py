"""Prometheus metrics, made at each scrape from the same counters as the status."""

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
"""Shortest time between two look-ups of the files' sizes: a log may have thousands of files."""


@dataclass(frozen=True, slots=True)
class PartFigures:
    """Figures that neither the status nor the counters have; the running parts report them."""

    input_queue_bytes: int = 0
    inbox_bytes: int = 0
    log_bytes: int = 0
    queries_waiting: int = 0
    snapshot_sequence: int = 0
    snapshot_ok: bool = True
    memory_counted: int = 0


class Disk:
    """Sizes of the log, the store and the spill file, and the free space on their disks."""

    def __init__(self, log: Path, store: Path | None, spill: Path | None = None) -> None:
        self._log = log
        self._store = store
        self._spill = spill
        self._looked = float("-inf")
        self._sizes: dict[str, tuple[int, int]] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Return (bytes used, bytes free on the disk) of "log", and of "store" and "spill" if they are configured.

        The figures may be `DISK_SECONDS` old.
        """
        now = time.monotonic()
        if now - self._looked >= DISK_SECONDS:
            self._looked = now
            self._sizes = {"log": (_total(self._log.glob("*.mcap*")), _free(self._log))}
            if self._store is not None:
                parts = self._store.parent.glob(f"{self._store.name}*")
                self._sizes["store"] = (_total(parts), _free(self._store.parent))
            if self._spill is not None:
                # Blocks and not its length: the file has holes.
                size = self._spill.stat().st_blocks * 512 if self._spill.exists() else 0
                self._sizes["spill"] = (size, _free(self._spill.parent))
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
    """All metrics of one service; ``problems`` returns those of its readiness, ``lost`` the sentences on its inputs."""

    def __init__(
        self,
        status: Callable[[], MapStatus],
        counters: Counters,
        figures: Callable[[], PartFigures],
        problems: Callable[[], Mapping[Problem, str]],
        lost: Callable[[], Mapping[str, str]],
        disk: Disk,
        memory_limit: int,
    ) -> None:
        self._status = status
        self._counters = counters
        self._figures = figures
        self._problems = problems
        self._lost = lost
        self._disk = disk
        self._memory_limit = memory_limit
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format. Waits for the rest of one scan's integration at most."""
        return generate_latest(self._registry)

    def describe(self) -> Iterable[Metric]:
        """Return nothing, so that registering does not collect."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield every family, from one status and one copy of the counters."""
        status, counts, figures = self._status(), self._counters.snapshot(), self._figures()
        build = {"version": status.version, "python": platform.python_version()}
        yield InfoMetricFamily("roughmap_build", "Version of roughmap and of Python.", value=build)
        named = {"map": status.map, "frame_id": status.frame_id, "error_model": status.error_model}
        labels = {**named, "instance": status.instance, "configuration_digest": status.configuration_digest}
        yield InfoMetricFamily("roughmap_map", "The served map.", value=labels)
        yield from self._inputs(status)
        yield _durations("lag", "Time from a cloud's arrival until queries see it.", {"": counts.lag})
        yield _durations("integration", "Time to place a cloud and add it to the map.", {"": counts.integration})
        yield _durations("log_sync", "Time to sync the log to disk (fsync).", {"": counts.log_sync})
        yield _durations("query", "Time to answer tile, region and cells queries.", counts.queries, "outcome")
        yield _counter(
            "outputs_dropped", "Records of answers and updates that the log dropped for lack of room.", "kind",
            {"queries": 0, "updates": 0} | counts.outputs_dropped,
        )  # fmt: skip
        yield from self._state(status)
        yield _counter("tiles_forgotten", "Level-0 tiles that the map forgot.", value=counts.tiles_forgotten)
        yield _gauge(
            "queue_bytes", "Messages to be numbered (intake), clouds (inbox), records for the disk (log).", "queue",
            {"intake": figures.input_queue_bytes, "inbox": figures.inbox_bytes, "log": figures.log_bytes},
        )  # fmt: skip
        yield _gauge(
            "memory_counted_bytes", "Memory that counts against map.memory_limit.", value=figures.memory_counted
        )
        yield _gauge("queries_waiting", "Queries that wait for a worker.", value=figures.queries_waiting)
        yield _gauge("snapshot_sequence", "Sequence of the map in the store.", value=figures.snapshot_sequence)
        yield _gauge("snapshot_ok", "1 unless the last snapshot failed.", value=figures.snapshot_ok)
        sizes = self._disk.sizes()
        yield _gauge("disk_bytes", "Size of the log files, the store and the spill file.", "what", _part(sizes, 0))
        yield _gauge("disk_free_bytes", "Free space on the disk of each.", "what", _part(sizes, 1))

    def _inputs(self, status: MapStatus) -> Iterator[Metric]:
        clouds, points, poses = status.clouds, status.points, status.poses
        yield _counter("clouds_accepted", "Clouds integrated.", value=clouds.accepted)
        rejected = _all(CloudReason, clouds.rejected)
        yield _counter("clouds_rejected", "Clouds logged but not integrated.", "reason", rejected)
        yield _gauge("clouds_waiting", "Clouds that wait for a decision.", value=clouds.waiting)
        yield _counter("points_accepted", "Points added to the map.", value=points.accepted)
        rejected = _all(PointReason, points.rejected)
        yield _counter("points_rejected", "Points not added to the map.", "reason", rejected)
        yield _counter("poses_accepted", "Poses used.", value=poses.accepted)
        rejected = _all(PoseReason, poses.rejected)
        yield _counter("poses_rejected", "Poses logged but not used.", "reason", rejected)
        refused = _all(Refusal, status.refused)
        yield _counter("messages_refused", "Messages refused before they were logged.", "reason", refused)
        # The counters bound the number of robots, see `counters.OTHERS`.
        yield _counter("messages_missing", "Sent messages that never arrived.", "robot", status.gaps)
        yield _counter("transform_jumps", "Jumps of a robot's frame transform.", "robot", status.jumps)

    def _state(self, status: MapStatus) -> Iterator[Metric]:
        problems = self._problems()
        yield _gauge("ready", "1 if the service accepts messages and answers queries.", value=is_ready(problems))
        present = {str(problem): problem in problems for problem in Problem}
        yield _gauge("problem", "1 for each current problem.", "problem", present)
        lost = GaugeMetricFamily(
            "roughmap_input_lost", "1 for each robot or sensor whose messages come to nothing.",
            labels=["subject", "text"],
        )  # fmt: skip
        for subject, text in self._lost().items():
            lost.add_metric([subject, text], 1)
        yield lost
        health = {state: status.health == state for state in ("ok", "overloaded", "degraded")}
        yield _gauge("health", "1 for the current state of health.", "state", health)
        yield _gauge("log_ok", "1 if the log can be written.", value=status.log.ok)
        yield _gauge("log_file_bytes", "Size of the log file that is being written.", value=status.log.bytes)
        if status.log.bytes_per_hour is not None:
            text = "Bytes an hour by which the log grows, over the last minutes."
            yield _gauge("log_bytes_per_hour", text, value=status.log.bytes_per_hour)
        yield _gauge("sequence", "Sequence of the map: +1 with each integrated cloud or reset.", value=status.sequence)
        yield _gauge(
            "durable_sequence", "Sequence of the map that the log on disk reproduces.", value=status.durable_sequence
        )
        yield _gauge("epoch", "Epoch of the map: +1 with each start or reset.", value=status.epoch)
        yield _gauge("input", "Number of the last logged message.", value=status.input)
        yield _gauge(
            "newest_stamp_seconds", "Stamp of the newest point in the map.", value=status.newest_stamp_ns / 1e9
        )
        tiles = {"resident": status.tiles.resident, "spilled": status.tiles.spilled}
        yield _gauge("tiles", "Level-0 tiles, by where they are: in memory or spilled.", "where", tiles)
        yield _gauge("memory_bytes", "Resident memory of the process.", value=status.memory_bytes)
        yield _gauge("memory_limit_bytes", "The setting map.memory_limit.", value=self._memory_limit)
        yield _gauge("uptime_seconds", "Time since this start.", value=status.uptime_s)


def _all(reasons: type[R], counts: Mapping[R, int]) -> dict[str, float]:
    """Return the count of every reason, zeros included: a rate needs a first value."""
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
