"""Logging a run's inputs and events under the topics of its map."""

from roughmap_schemas import Event, Keys, encode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.channels import input_topic
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter


class Recorder:
    """Queues inputs and events to a `LogWriter`; never blocks and never fails, as `LogWriter.put`."""

    def __init__(self, writer: LogWriter, keys: Keys) -> None:
        self._writer = writer
        self._keys = keys

    def input(self, kind: Kind, robot: str, payload: bytes, received_ns: int, stamp_ns: int, number: int) -> None:
        """Log the input ``number`` (from 1 over the run), a message of ``robot``."""
        topic = input_topic(kind, robot, self._keys)
        self._writer.put(LogRecord(kind, topic, payload, received_ns, stamp_ns, number))

    def event(self, event: Event, now_ns: int) -> None:
        """Log an event."""
        record = LogRecord(
            Kind.EVENTS, self._keys.events, encode_event(event), now_ns, now_ns,
            epoch=event.epoch, sequence=event.sequence,
        )  # fmt: skip
        self._writer.put(record)
