"""Answers to ingest requests, sent from a thread of their own."""

import contextlib
import logging
import queue
import threading
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas import Fault, QueryError, Receipt, model_bytes
from roughmap_schemas.encodings import json_encoding

logger = logging.getLogger(__name__)

RECEIPT = json_encoding("Receipt")
QUERY_ERROR = json_encoding("QueryError")

MAX_REPLIES = 10_000
"""Answers that wait to be sent. Past it answers are dropped: a client that gets none sends its message again."""


class ReceiptSender:
    """Sends answers from its own thread: a client that stops reading blocks a reply for 5 s; the log must not wait."""

    def __init__(self) -> None:
        self._queue: queue.Queue[tuple[zenoh.Query, bytes, bool] | None] = queue.Queue(MAX_REPLIES)
        self._thread = threading.Thread(target=self._run, name="receipts", daemon=True)
        self._thread.start()

    def send(self, query: zenoh.Query, payload: bytes, *, is_error: bool) -> None:
        """Queue an answer without blocking."""
        try:
            self._queue.put_nowait((query, payload, is_error))
        except queue.Full:
            query.drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self, timeout: float = 6.0) -> None:
        """Send queued answers for at most ``timeout`` s."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=timeout)
        self._thread.join(timeout)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            query, payload, is_error = item
            try:
                if is_error:
                    query.reply_err(payload, encoding=QUERY_ERROR)
                else:
                    query.reply(query.key_expr, payload, encoding=RECEIPT)
            except zenoh.ZError as error:
                logger.debug("could not send a receipt: %s", error)
            finally:
                query.drop()


class IngestReply:
    """The answer to one ingest request."""

    def __init__(self, query: zenoh.Query, sender: ReceiptSender) -> None:
        self._query = query
        self._sender = sender

    def receipt(self, receipt: Receipt) -> None:
        """Confirm that the message is in the log on the disk."""
        self._sender.send(self._query, model_bytes(receipt), is_error=False)

    def refuse(self, fault: Fault) -> None:
        """Say why the message was not logged."""
        error = QueryError(code=fault.code, message=fault.message)
        self._sender.send(self._query, model_bytes(error), is_error=True)
