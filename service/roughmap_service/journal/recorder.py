"""A run's records on their way to the log."""

from roughmap_schemas import Event, Keys
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.file import LogRecord, event_record
from roughmap_service.journal.writer import LogWriter


class Recorder:
    """Queues messages and events to the log, each under its topic."""

    def __init__(self, writer: LogWriter, keys: Keys) -> None:
        self._writer = writer
        self._keys = keys

    def input(self, kind: Kind, robot: str, payload: bytes, received_ns: int, stamp_ns: int, number: int) -> None:
        """Queue a message as input ``number``."""
        topic = self._keys.form(kind).make(robot=robot)
        self._writer.put(LogRecord(kind, topic, payload, received_ns, stamp_ns, number))

    def event(self, event: Event, now_ns: int) -> None:
        """Queue an event."""
        self._writer.put(event_record(self._keys.events, event, now_ns))
