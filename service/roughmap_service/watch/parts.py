"""The parts of the running service: their problems, their figures for the pages, and a summary when they end."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from roughmap_schemas import Config
from roughmap_schemas.messages import LogState, MapStatus
from roughmap_service.answers.queryables import Answers
from roughmap_service.engine.sequencer import Sequencer
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_growth import LogGrowth, hours_to_full
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.inputs.ros2 import Ros2Inputs
from roughmap_service.inputs.streams import Streams
from roughmap_service.journal.writer import LogWriter
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.snapshots import Snapshots
from roughmap_service.watch.readiness import Problem, Sources, running_problems

logger = logging.getLogger(__name__)


@dataclass
class RunningParts:
    """The parts of a running service that are watched."""

    sequencer: Sequencer
    writer: LogWriter
    queue: InputQueue
    snapshots: Snapshots
    memory: MemoryLimit
    counters: Counters
    streams: Streams
    keep: int | None = None
    """`log.keep` in bytes."""
    growth: LogGrowth = field(default_factory=LogGrowth)
    ros2: Ros2Inputs | None = None
    _stalled: bool = False

    def problems(self) -> dict[Problem, str]:
        """Return the current problems, each with its cause."""
        return running_problems(
            alive=self.sequencer.alive, turned=self.sequencer.turned, failure=self.sequencer.failure,
            log_ok=self.writer.ok, log_error=self.writer.error, memory_ok=self.memory.ok,
            store_ok=self.snapshots.ok, store_error=self.snapshots.error, overloaded=self.counters.overloaded,
            lost=self.lost().values(),
        )  # fmt: skip

    def lost(self) -> dict[str, str]:
        """Return a sentence on each robot, sensor and ROS topic whose messages come to nothing."""
        return self.streams.problems() | ({} if self.ros2 is None else self.ros2.problems())

    def log_state(self) -> LogState:
        """Return the state of the log, and how it grows."""
        writer = self.writer
        per_hour = self.growth.per_hour(writer.total)
        hours = hours_to_full(per_hour, writer.free, self.keep)
        return LogState(
            file=str(writer.path), bytes=writer.size, ok=writer.ok, bytes_per_hour=per_hour, hours_to_full_disk=hours,
            keep=self.keep,
        )  # fmt: skip

    def watch(self) -> None:
        """Check for parts that hang, and log when a stall begins and ends. Call it regularly from a thread that waits
        for no disk: a thread that hangs cannot report it."""
        self.writer.look()
        self.snapshots.look()
        why = self.problems().get(Problem.SEQUENCER_STALLED, "")
        if why and not self._stalled:
            note(logger, logging.ERROR, "stalled", why, always=True)
        elif self._stalled and not why:
            note(logger, logging.WARNING, "stall_ended", "the sequencer works again", always=True)
        self._stalled = bool(why)

    def end(self, sources: Sources) -> None:
        """Report the shutdown to the pages, and log what was integrated since the start."""
        sources.readiness.end()
        counts, sequence = self.counters.snapshot(), self.sequencer.live.run.map.sequence
        clouds, points = counts.clouds_accepted, counts.points_accepted
        text = f"shutting down; integrated {clouds} clouds with {points} points since the start"
        note(
            logger, logging.INFO, "shutdown", text, clouds=clouds, points=points, poses=counts.poses_accepted,
            clouds_rejected=counts.clouds_rejected, refused=counts.refused, sequence=sequence,
        )  # fmt: skip


def connect_pages(
    parts: RunningParts, answers: Answers, sources: Sources, status: Callable[[], MapStatus], config: Config
) -> None:
    """Make the pages show these parts."""
    sources.readiness.become(parts.problems)
    sources.recent, sources.log = parts.streams.recent.told, parts.log_state
    if sources.url is None:
        return
    from roughmap_service.watch.metrics import Disk, Metrics, PartFigures  # noqa: PLC0415 - needed with pages only

    def figures() -> PartFigures:
        return PartFigures(
            input_queue_bytes=parts.queue.held,
            inbox_bytes=parts.sequencer.live.run.inbox.size,
            log_bytes=parts.writer.held,
            queries_waiting=answers.waiting,
            snapshot_sequence=parts.snapshots.sequence,
            snapshot_ok=not parts.snapshots.error,
            memory_counted=parts.memory.taken,
        )

    store = None if config.store.path is None else Path(config.store.path)
    disk = Disk(Path(config.log.directory), store, parts.memory.spill.path)
    metrics = Metrics(
        status, parts.counters, figures, sources.readiness.problems, parts.lost, disk,
        config.map.memory_limit,
    )  # fmt: skip
    sources.status, sources.metrics = status, metrics.text
