"""The log of a replay: the same inputs, and the events of this replay."""

import errno
import time
import uuid
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

from roughmap_schemas import Config, Keys, RunMetadata, encode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.file import LogRecord
from roughmap_service.journal.reader import FileStart, InputRecord
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.apply import RunState
from roughmap_service.run.fold import Step

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
        self._run = uuid.uuid4().hex
        self._writer: LogWriter | None = None
        self._keys = Keys("site")

    def take(self, step: Step, state: RunState) -> None:
        """Write one step; ``state`` is the run's state after it."""
        item = step.item
        if isinstance(item, FileStart):
            self._begin(item.config, state)
            return
        writer = self._writer
        if writer is None:  # a log begins with a FileStart
            return
        if isinstance(item, InputRecord):
            topic = self._keys.form(item.kind).make(robot=item.robot)
            record = LogRecord(item.kind, topic, item.payload, item.received_ns, item.stamp_ns, item.number)
        elif step.outcome is not None:
            record = LogRecord(
                Kind.EVENTS, self._keys.events, encode_event(step.outcome), item.received_ns, item.received_ns,
                epoch=step.outcome.epoch, sequence=step.outcome.sequence,
            )  # fmt: skip
        else:
            return
        if not writer.wait_room(ROOM_SECONDS):
            raise OSError(errno.EIO, writer.error or "the disk is too slow", str(writer.path))
        writer.put(record)

    def _begin(self, config: Config, state: RunState) -> None:
        self._end()
        self._keys = Keys(config.map.name, config.keys)
        metadata = RunMetadata(
            run=self._run,
            created_ns=time.time_ns(),
            epoch=state.epoch,
            index=0 if self._writer is None else self._writer.index + 1,
            first_input=state.input + 1,
            first_record=state.record + 1,
            base_sequence=state.map.sequence,
            base_digest=state.map.digest(),
            version=version("roughmap"),
            configuration=config.public_dict(),
        )
        self._writer = LogWriter(self._directory, metadata, compression=config.log.compression)

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
