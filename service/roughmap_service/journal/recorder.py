"""Logging a run's inputs and events under the topics of its map."""

from roughmap_schemas import Event, Keys, encode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.journal.channels import input_topic
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter


class Recorder:
    """Queues inputs and events to a `LogWriter`; never blocks and never fails, as `LogWriter.put`.

    ``last_ns`` is the log time of the run's last message. Log times are wall times, raised where needed, so that they
    rise whatever the clock does.
    """

    def __init__(self, writer: LogWriter, keys: Keys) -> None:
        self._writer = writer
        self._keys = keys
        self.last_ns = writer.begun_ns

    def input(self, kind: Kind, robot: str, payload: bytes, received_ns: int, stamp_ns: int, number: int) -> int:
        """Log the input ``number`` (from 1 over the run), a message of ``robot``. Return its log time."""
        topic = input_topic(kind, robot, self._keys)
        self.last_ns = max(received_ns, self.last_ns + 1)
        self._writer.put(LogRecord(kind, topic, payload, self.last_ns, stamp_ns, number))
        return self.last_ns

    def event(self, event: Event, now_ns: int) -> bytes:
        """Log an event. Return its JSON."""
        self.last_ns = max(now_ns, self.last_ns + 1)
        payload = encode_event(event)
        record = LogRecord(
            Kind.EVENTS, self._keys.events, payload, self.last_ns, now_ns, epoch=event.epoch, sequence=event.sequence
        )
        self._writer.put(record)
        return payload
