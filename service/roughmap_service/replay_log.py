"""A replay's own log: the same inputs, and the events as they came out this time."""

import time
import uuid
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

from roughmap_schemas import Config, Keys, RunMetadata, encode_event

from .apply import RunState
from .fold import Step
from .log_file import Kind, LogRecord
from .log_reader import EventRecord, InputRecord
from .log_writer import LogWriter

CLOSE_SECONDS = 60.0
"""How long the last bytes may take to the disk; nobody waits for anything else then."""

ROOM_SECONDS = 60.0
"""How long a disk may take to catch up before the replay gives up."""


class ReplayLog:
    """Writes what a replay does as a new run into an empty or new directory; a context manager."""

    def __init__(self, directory: Path, config: Config, state: RunState) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.glob("*.mcap")):
            raise FileExistsError(17, "there are logs there already; name an empty folder", str(directory))
        self._keys = Keys(config.map.name, config.keys)
        metadata = RunMetadata(
            run=uuid.uuid4().hex,
            created_ns=time.time_ns(),
            epoch=1,
            index=0,
            first_input=state.input + 1,
            first_record=state.record + 1,
            base_sequence=state.map.sequence,
            base_digest=state.map.digest(),
            version=version("roughmap"),
            configuration=config.public_dict(),
        )
        self._writer = LogWriter(directory, metadata, compression=config.log.compression)

    def take(self, step: Step) -> None:
        """Write one step."""
        item = step.item
        if isinstance(item, InputRecord):
            topic = self._keys.form(item.kind).make(robot=item.robot)
            record = LogRecord(item.kind, topic, item.payload, item.received_ns, item.stamp_ns, item.number)
        elif isinstance(item, EventRecord) and step.outcome is not None:
            record = LogRecord(
                Kind.EVENTS, self._keys.events, encode_event(step.outcome), item.received_ns, item.received_ns,
                epoch=step.outcome.epoch, sequence=step.outcome.sequence,
            )  # fmt: skip
        else:
            return
        if not self._writer.wait_room(ROOM_SECONDS):
            raise OSError(5, self._writer.error or "the disk does not keep up", str(self._writer.path))
        self._writer.put(record)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._writer.close(CLOSE_SECONDS) and error is None:
            raise OSError(5, self._writer.error or "the log could not be closed", str(self._writer.path))
