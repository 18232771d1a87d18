"""Answers to ingest requests, sent from a thread that may be held up; and the memory for duplicates."""

import contextlib
import logging
import queue
import threading
from collections import OrderedDict
from collections.abc import Iterable
from types import TracebackType
from typing import Self

import xxhash
import zenoh

from roughmap_schemas import Fault, QueryError, Receipt, model_bytes
from roughmap_schemas.encodings import json_encoding

from .log_file import Kind

log = logging.getLogger(__name__)

RECEIPT = json_encoding("Receipt")
QUERY_ERROR = json_encoding("QueryError")

MAX_REPLIES = 10_000
"""Answers on their way out. A client that hears nothing sends again, so one dropped at this limit does no harm."""


class Replies:
    """Sends answers from its own thread: a client that stops reading holds a reply for 5 s; the log must not wait."""

    def __init__(self) -> None:
        self._queue: queue.Queue[tuple[zenoh.Query, bytes, bool] | None] = queue.Queue(MAX_REPLIES)
        self._thread = threading.Thread(target=self._run, name="replies", daemon=True)
        self._thread.start()

    def send(self, query: zenoh.Query, payload: bytes, *, is_error: bool) -> None:
        """Queue an answer; never blocks."""
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
        """Send what is queued, for at most ``timeout`` s."""
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
                log.debug("a receipt could not be sent: %s", error)
            finally:
                query.drop()


class IngestReply:
    """The answer that one ingest request waits for."""

    def __init__(self, query: zenoh.Query, replies: Replies) -> None:
        self._query = query
        self._replies = replies

    def receipt(self, receipt: Receipt) -> None:
        """The log holds the message, on the disk."""
        self._replies.send(self._query, model_bytes(receipt), is_error=False)

    def refuse(self, fault: Fault) -> None:
        """The message was not logged."""
        error = QueryError(code=fault.code, message=fault.message)
        self._replies.send(self._query, model_bytes(error), is_error=True)


Identity = tuple[str, str, str]
"""Robot, kind and hash of a message."""


class Duplicates:
    """The last messages by robot, kind and the 128-bit hash of their bytes, each with the input number it got.

    Past the limit the oldest of the robot that has most is forgotten: who sends very many has no other's forgotten.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._number = 0
        self._seen: dict[str, OrderedDict[Identity, int]] = {}

    @staticmethod
    def identity(robot: str, kind: Kind, payload: bytes) -> Identity:
        """What makes two messages the same one."""
        return robot, kind.value, xxhash.xxh3_128_hexdigest(payload)

    def find(self, identity: Identity) -> int | None:
        """The input number of that message, None if it is not among the last ones."""
        of = self._seen.get(identity[0])
        return None if of is None else of.get(identity)

    def add(self, identity: Identity, number: int) -> None:
        """Remember a message as the newest, and forget one past the limit."""
        of = self._seen.setdefault(identity[0], OrderedDict())
        self._number += of.pop(identity, None) is None
        of[identity] = number
        while self._number > self._limit:
            max(self._seen.values(), key=len).popitem(last=False)
            self._number -= 1

    def to_state(self) -> list[tuple[str, str, str, int]]:
        """All, oldest first."""
        seen = [(*identity, number) for of in self._seen.values() for identity, number in of.items()]
        return sorted(seen, key=lambda one: one[3])

    def load_state(self, state: Iterable[tuple[str, str, str, int]]) -> None:
        """The inverse of `to_state`."""
        for robot, kind, digest, number in state:
            self.add((robot, kind, digest), number)
