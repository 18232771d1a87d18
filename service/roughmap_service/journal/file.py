"""One MCAP file of the log: its name, its beginning, its channels, and how it gets to the disk."""

import contextlib
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from roughmap_schemas import RunMetadata
from roughmap_schemas.kinds import Kind
from roughmap_schemas.run_metadata import RECORD_NAME
from roughmap_service.host.disk import sync, sync_directory
from roughmap_service.journal.channels import channel_schema
from roughmap_service.journal.mcap_writer import McapWriter
from roughmap_service.journal.records import LogRecord

CHUNK_BYTES = 64 * 1024
"""Chunk size. Small chunks lose little to a kill; a scan is larger and gets a chunk of its own."""

PROFILE = "roughmap"

OpenFile = Callable[[Path], IO[bytes]]

FILE_NAME = re.compile(r"roughmap-(?P<run>[0-9a-f]{32})-\d{6,}\.mcap")
"""Names of log files."""


def file_name(run: str, index: int) -> str:
    """Return the name of a run's file. Names sort in the order of writing."""
    return f"roughmap-{run}-{index:06d}.mcap"


def open_new(path: Path) -> IO[bytes]:
    """Create a file; FileExistsError if it is there already."""
    return path.open("xb")


class LogFile:
    """An open log file. Any method may raise OSError; what was flushed before stays readable.

    ``last_ns`` is the log time of the run's last message before this file: log times rise over the files of a run.
    """

    def __init__(
        self,
        path: Path,
        metadata: RunMetadata,
        compression: str,
        open_file: OpenFile = open_new,
        *,
        last_ns: int = 0,
    ) -> None:
        self.path = path
        self.opened = time.monotonic()
        self.last_ns = last_ns
        self._closed = False
        self._stream = open_file(path)
        try:
            self._writer = McapWriter(self._stream, chunk_bytes=CHUNK_BYTES, compression=compression)
            self._channels: dict[tuple[Kind, str], int] = {}
            self._schemas: dict[Kind, int] = {}
            self._writer.start(PROFILE)
            self._writer.add_metadata(RECORD_NAME, metadata.to_record())
            self.sync()
            sync_directory(path.parent)
        except BaseException:
            self.let_go()
            raise

    @property
    def closed(self) -> bool:
        """Whether the footer is on the disk."""
        return self._closed

    @property
    def size(self) -> int:
        """Bytes written to the file so far."""
        return self._stream.tell()

    def write(self, record: LogRecord) -> None:
        """Append a message. Its log time is its receive time, raised where needed: log times rise in file order."""
        self.last_ns = max(record.received_ns, self.last_ns + 1)
        channel, number = self._channel(record.kind, record.topic), record.number & 0xFFFFFFFF
        self._writer.add_message(channel, self.last_ns, record.payload, record.stamp_ns, number)

    def flush(self) -> int:
        """End the chunk and hand everything to the operating system; return the file's length."""
        self._writer.flush()
        return self._stream.tell()

    def sync(self) -> int:
        """Flush, and bring everything to the disk; return the file's length."""
        length = self.flush()
        os.fsync(self._stream.fileno())
        return length

    def close(self) -> None:
        """Write the footer, sync and close. The file is never appended to after this."""
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._closed = True
        self._stream.close()

    def let_go(self) -> None:
        """Close the stream of a file that failed, without a footer."""
        with contextlib.suppress(OSError):  # closing flushes, which is what failed
            self._stream.close()

    def abandon(self, length: int) -> None:
        """Close the file without a footer, truncated to the ``length`` that was synced.

        The truncation is on the disk when this returns, since the next file repeats what came after ``length``. A file
        that has its footer on the disk stays as it is.
        """
        self.let_go()
        if not self._closed:
            os.truncate(self.path, length)
            sync(self.path)

    def _channel(self, kind: Kind, topic: str) -> int:
        if (kind, topic) not in self._channels:
            encoding = channel_schema(kind).message_encoding
            self._channels[kind, topic] = self._writer.register_channel(topic, encoding, self._schema(kind))
        return self._channels[kind, topic]

    def _schema(self, kind: Kind) -> int:
        if kind not in self._schemas:
            schema = channel_schema(kind)
            self._schemas[kind] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._schemas[kind]
