"""A log changed by hand, as nobody should: messages of a file replaced or left out, the file whole again."""

from collections.abc import Callable
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import Writer

from roughmap_schemas import RunMetadata
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.reader import raw_records

Edit = Callable[[str, bytes], bytes | None]
"""Topic and payload to the payload that stands there instead, None for none."""


def rewrite(path: Path, edit: Edit = lambda _topic, data: data, **changes: object) -> None:
    """Write a log file anew with its messages edited and ``changes`` in its metadata."""
    records = [record for record, _ in raw_records(path)]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="roughmap")
        schemas: dict[int, int] = {}
        channels: dict[int, tuple[int, str]] = {}
        for record in records:
            if isinstance(record, Metadata):
                values = RunMetadata.from_record(record.metadata).model_copy(update=changes)
                writer.add_metadata(RECORD_NAME, values.to_record())
            elif isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = (
                    writer.register_channel(record.topic, record.message_encoding, schemas[record.schema_id]),
                    record.topic,
                )
            elif isinstance(record, Message):
                channel, topic = channels[record.channel_id]
                data = edit(topic, record.data)
                if data is not None:
                    writer.add_message(channel, record.log_time, data, record.publish_time, record.sequence)
        writer.finish()


def nth(topic_end: str, n: int, change: Callable[[bytes], bytes | None]) -> Edit:
    """An edit of the ``n``-th message, from 0, of the topics that end so."""
    seen = -1

    def edit(topic: str, data: bytes) -> bytes | None:
        nonlocal seen
        if not topic.endswith(topic_end):
            return data
        seen += 1
        return change(data) if seen == n else data

    return edit
