"""What the log holds, as plain data: a message on its way into a file, and what is read back from one."""

from dataclasses import dataclass
from pathlib import Path

from roughmap_schemas import Config, Event, RunMetadata
from roughmap_schemas.kinds import Kind


@dataclass(frozen=True, slots=True)
class LogRecord:
    """A message to be written.

    Times are in ns. ``number`` belongs to an input (0 for anything else), ``epoch`` and ``sequence`` to an event.
    """

    kind: Kind
    topic: str
    payload: bytes
    received_ns: int
    stamp_ns: int
    number: int = 0
    epoch: int = 0
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class FileStart:
    """The beginning of a file, as read back."""

    path: Path
    metadata: RunMetadata
    config: Config


@dataclass(frozen=True, slots=True)
class InputRecord:
    """An input, as read back.

    ``number`` counts inputs and ``record`` counts inputs and events together, both from 1 over the run. Times are in
    ns.
    """

    number: int
    record: int
    kind: Kind
    robot: str
    payload: bytes
    received_ns: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class EventRecord:
    """An event, as read back. ``record`` counts as in `InputRecord`."""

    record: int
    event: Event
    received_ns: int


LogItem = FileStart | InputRecord | EventRecord
