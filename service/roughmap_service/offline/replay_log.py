"""The log of a replay: the same inputs, and the events of this replay."""

import errno
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Self

from roughmap_schemas import Config, Keys
from roughmap_service.journal.recorder import Recorder
from roughmap_service.journal.records import FileStart, InputRecord
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.fold import Step
from roughmap_service.run.metadata import file_metadata
from roughmap_service.run.run import Run

CLOSE_SECONDS = 60.0
"""Seconds that the last bytes may take to reach the disk; there is nothing else to do then."""

ROOM_SECONDS = 60.0
"""Seconds that the disk may take to catch up before the replay fails."""


def check_empty(directory: Path) -> None:
    """Raise FileExistsError unless the directory is empty or new: logs of two runs must not share one."""
    if directory.exists() and any(directory.iterdir()):
        raise FileExistsError(errno.EEXIST, "is not empty; name an empty or new folder", str(directory))


class ReplayLog:
    """Writes a replay as a new run into an empty or new directory; a context manager.

    It begins a new file where the replayed log did, since the settings may change there.
    """

    def __init__(self, directory: Path) -> None:
        check_empty(directory)
        directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._run_id = uuid.uuid4().hex
        self._writer: LogWriter | None = None
        self._recorder: Recorder | None = None

    def take(self, step: Step, run: Run) -> None:
        """Write one step; ``run`` is as it is after the step."""
        item = step.item
        if isinstance(item, FileStart):
            self._begin(item.config, run)
            return
        writer, recorder = self._writer, self._recorder
        if writer is None or recorder is None:  # a log begins with a FileStart
            return
        if not writer.wait_room(ROOM_SECONDS):
            raise OSError(errno.EIO, writer.error or "the disk is too slow", str(writer.path))
        if isinstance(item, InputRecord):
            recorder.input(item.kind, item.robot, item.payload, item.received_ns, item.stamp_ns, item.number)
        elif step.outcome is not None:
            recorder.event(step.outcome, item.received_ns)

    def _begin(self, config: Config, run: Run) -> None:
        self._end()
        index = 0 if self._writer is None else self._writer.index + 1
        metadata = file_metadata(self._run_id, run, config, epoch=run.epoch, index=index, created_ns=time.time_ns())
        self._writer = LogWriter(self._directory, metadata, compression=config.log.compression)
        self._recorder = Recorder(self._writer, Keys(config.map.name, config.keys))

    def _end(self) -> None:
        if self._writer is not None and not self._writer.close(CLOSE_SECONDS):
            raise OSError(errno.EIO, self._writer.error or "the log could not be closed", str(self._writer.path))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._end()
        except OSError:
            if error is None:
                raise
