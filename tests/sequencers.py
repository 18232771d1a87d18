"""A sequencer for tests, with ample memory and without periodic checkpoints and snapshots."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roughmap_service.engine.live_run import LiveRun
from roughmap_service.engine.sequencer import Intervals, Sequencer
from roughmap_service.inputs.queue import InputQueue
from roughmap_service.journal.writer import LogWriter
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.spill import Spill


@contextmanager
def ample_memory(folder: Path) -> Iterator[MemoryLimit]:
    """Yield a memory limit that is never reached."""
    with Spill(folder / "tiles.spill", 1 << 30) as spill:
        yield MemoryLimit(1 << 40, spill)


def sequencer_of(
    live: LiveRun,
    queue: InputQueue,
    writer: LogWriter,
    memory: MemoryLimit,
) -> Sequencer:
    return Sequencer(live, queue, writer, memory, Intervals(3600.0, 3600.0), take_snapshot=lambda: None)
