"""One query from its arrival to its end: its replies, its error, its record in the log."""

import logging
import time
from collections.abc import Callable

import zenoh

from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.faults import Fault, QueryFault
from roughmap_schemas.messages import QueryError, QueryRecord, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import MAX_PLACES_TEXT
from roughmap_service.answers.plan import Reply
from roughmap_service.host.ending import ShuttingDown

logger = logging.getLogger(__name__)

ERROR_ENCODING = json_encoding("QueryError")

CODES: tuple[tuple[type[Exception], QueryCode], ...] = (
    (MemoryError, QueryCode.TOO_LARGE),
    (ShuttingDown, QueryCode.SHUTTING_DOWN),
    (Exception, QueryCode.INTERNAL),
)
"""Codes of errors that are not a `Fault`; the first match counts."""

MAX_SELECTOR = 2000
"""Characters of a selector that the log keeps. Valid selectors are shorter; others may have megabytes."""


class Question:
    """One query. It ends once, by `done` or `refuse`; ``record`` then takes its record."""

    def __init__(self, query: zenoh.Query, record: Callable[[QueryRecord], None]) -> None:
        self._query = query
        self._record = record
        self._replies = 0
        self._started_ns = time.monotonic_ns()
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)

    @property
    def payload(self) -> bytes:
        """The query's payload; empty if there is none."""
        payload = self._query.payload
        return b"" if payload is None else payload.to_bytes()

    def check_size(self) -> None:
        """Raise QueryFault (``too_large``) for a large payload or attachment: both stay in memory until the end."""
        for what, sent in (("payload", self._query.payload), ("attachment", self._query.attachment)):
            if sent is not None and len(sent) > MAX_PLACES_TEXT:
                raise QueryFault(
                    QueryCode.TOO_LARGE, f"{what}: expected at most {MAX_PLACES_TEXT} bytes; found {len(sent)}"
                )

    def send(self, reply: Reply) -> None:
        """Send one reply. Blocks for up to 5 s while the client does not read; then Zenoh closes its link."""
        self._query.reply(reply.key, reply.payload, encoding=reply.encoding, attachment=reply.attachment)
        self._replies += 1

    def done(self, sequence: int) -> None:
        """End after the last reply; ``sequence`` is the map's, in the answer."""
        self._end("ok", self._replies, sequence)

    def refuse(self, error: Exception) -> None:
        """Reply with an error, and end."""
        code, message = as_fault(error)
        if code == QueryCode.INTERNAL:
            logger.error("query failed: %s?%s", self.key, self.parameters, exc_info=error)
        try:
            self._query.reply_err(model_bytes(QueryError(code=code, message=message)), encoding=ERROR_ENCODING)
        except zenoh.ZError as gone:
            logger.info("cannot send error %s to the client: %s", code, gone)
        self._end(code, 0, 0)

    def _end(self, outcome: str, replies: int, sequence: int) -> None:
        self._query.drop()
        selector = f"{self.key}?{self.parameters}" if self.parameters else self.key
        self._record(
            QueryRecord(
                selector=selector[:MAX_SELECTOR],
                tiles=replies,
                sequence=sequence,
                duration_ns=time.monotonic_ns() - self._started_ns,
                outcome=outcome,
            )
        )


def as_fault(error: Exception) -> tuple[str, str]:
    """Return code and message for any error."""
    if isinstance(error, Fault):
        return error.code, error.message
    code = next(code for kind, code in CODES if isinstance(error, kind))
    return code, f"{type(error).__name__}: {error}"
