"""What the running service shows of itself: whether it is ready, its metrics, and what it did, when it ends."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from roughmap_schemas import Config
from roughmap_schemas.messages import MapStatus
from roughmap_service.answers.queryables import Answers
from roughmap_service.engine.sequencer import Sequencer
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.journal.writer import LogWriter
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.snapshots import Snapshots
from roughmap_service.watch.readiness import Problem, Sources, running_problems

log = logging.getLogger(__name__)


@dataclass
class Parts:
    """The parts of a running service that are looked at."""

    sequencer: Sequencer
    writer: LogWriter
    queue: InputQueue
    snapshots: Snapshots
    memory: MemoryLimit
    counters: Counters
    _stalled: bool = False

    def problems(self) -> dict[Problem, str]:
        """What is wrong now."""
        return running_problems(
            alive=self.sequencer.alive, turned=self.sequencer.turned, failure=self.sequencer.failure,
            log_ok=self.writer.ok, log_error=self.writer.error, memory_ok=self.memory.ok,
            store_ok=self.snapshots.ok, store_error=self.snapshots.error, overloaded=self.counters.overloaded,
        )  # fmt: skip

    def watch(self) -> None:
        """Look for what hangs, and tell of it when it begins and when it goes on; call it now and then, from a thread
        that waits for no disk."""
        self.writer.look()
        self.snapshots.look()
        why = self.problems().get(Problem.SEQUENCER_STALLED, "")
        if why and not self._stalled:
            note(log, logging.ERROR, "stalled", why, always=True)
        elif self._stalled and not why:
            note(log, logging.WARNING, "stall_ended", "the sequencer goes on", always=True)
        self._stalled = bool(why)

    def end(self, sources: Sources) -> None:
        """Say that it shuts down, and what it did since its start."""
        sources.readiness.end()
        counts, sequence = self.counters.snapshot(), self.sequencer.live.run.map.sequence
        clouds, points = counts.clouds_accepted, counts.points_accepted
        text = f"shutting down; {clouds} clouds with {points} points were integrated since the start"
        note(
            log, logging.INFO, "shutdown", text, clouds=clouds, points=points, poses=counts.poses_accepted,
            clouds_rejected=counts.clouds_rejected, refused=counts.refused, sequence=sequence,
        )  # fmt: skip


def show(parts: Parts, answers: Answers, sources: Sources, status: Callable[[], MapStatus], config: Config) -> None:
    """From now on the pages show these parts."""
    sources.readiness.become(parts.problems)
    if sources.url is None:
        return
    from roughmap_service.watch.metrics import Depths, Disk, Metrics  # noqa: PLC0415 - with the pages only

    def depths() -> Depths:
        return Depths(
            intake_bytes=parts.queue.held, inbox_bytes=parts.sequencer.live.run.inbox.size, log_bytes=parts.writer.held,
            queries_waiting=answers.waiting, snapshot_sequence=parts.snapshots.sequence,
            snapshot_ok=not parts.snapshots.error, memory_taken=parts.memory.taken,
        )  # fmt: skip

    store = None if config.store.path is None else Path(config.store.path)
    disk = Disk(Path(config.log.directory), store, parts.memory.spill.path)
    metrics = Metrics(status, parts.counters, depths, sources.readiness.problems, disk, config.map.memory_limit)
    sources.status, sources.metrics = status, metrics.text
