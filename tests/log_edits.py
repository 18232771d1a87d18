"""Edits of a log file: messages replaced or left out, in a file that is otherwise valid."""

from collections.abc import Callable
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import Writer

from roughmap_schemas import RunMetadata
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.journal.reader import raw_records

Edit = Callable[[str, bytes], bytes | None]
"""Maps a topic and its payload to the new payload; None removes the message."""


def rewrite(path: Path, edit: Edit = lambda _topic, data: data, **changes: object) -> None:
    """Rewrite a log file with its messages edited and ``changes`` in its metadata."""
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
    """Return an edit of the ``n``-th message, from 0, of the topics that end with ``topic_end``."""
    seen = -1

    def edit(topic: str, data: bytes) -> bytes | None:
        nonlocal seen
        if not topic.endswith(topic_end):
            return data
        seen += 1
        return change(data) if seen == n else data

    return edit
