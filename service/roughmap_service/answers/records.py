"""What the log keeps of answers and updates. It is not part of the run: without room it is dropped and counted."""

import time

from roughmap_schemas import Keys, QueryRecord, model_bytes
from roughmap_schemas.kinds import Kind
from roughmap_service.host.counters import Counters
from roughmap_service.journal.records import LogRecord
from roughmap_service.journal.writer import LogWriter


class OutputRecords:
    """Logs a record of each answered query, if ``queries``, and of each published tile."""

    def __init__(self, writer: LogWriter, keys: Keys, counters: Counters, *, queries: bool) -> None:
        self._writer = writer
        self._keys = keys
        self._counters = counters
        self._queries = queries

    def query(self, record: QueryRecord) -> None:
        """Count an answered query and log it."""
        self._counters.query(record.outcome, record.duration_ns / 1e9)
        if self._queries:
            self._put(Kind.QUERIES, self._keys.queries, model_bytes(record), time.time_ns())

    def update(self, kind: str, payload: bytes, stamp_ns: int) -> None:
        """Log a published tile: its grid (``kind`` "grids") or its key and TileInfo."""
        self._put(Kind.GRIDS if kind == "grids" else Kind.UPDATES, self._keys.updates_topic, payload, stamp_ns)

    def _put(self, kind: Kind, topic: str, payload: bytes, stamp_ns: int) -> None:
        if not self._writer.put_output(LogRecord(kind, topic, payload, time.time_ns(), stamp_ns)):
            self._counters.output_dropped("queries" if kind is Kind.QUERIES else "updates")
