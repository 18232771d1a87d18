"""Calls back with tiles as they change."""

import logging
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from roughmap_client.errors import NoAnswer, RoughMapError, short_message
from roughmap_client.results import Tile

logger = logging.getLogger(__name__)

END_S = 5.0
"""How long `Watch.close` waits for a running callback."""


class Watch:
    """A subscription and the thread that calls back; close it, or use it as a context manager.

    At most one update per tile waits, the newest. So a slow callback sees fewer states, and memory is bounded by the
    number of tiles.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        read: Callable[[zenoh.Sample], Tile],
        callback: Callable[[Tile], None],
        on_error: Callable[[RoughMapError], None] | None,
    ) -> None:
        self._read = read
        self._callback = callback
        self._on_error = on_error
        self._wake = threading.Condition()
        self._waiting: dict[str, zenoh.Sample] = {}
        self._closed = False
        self._session = session
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        try:
            self._subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(self._take, indirect=False))
        except zenoh.ZError as error:
            raise NoAnswer(f"can't watch {key}: {short_message(error)}") from None
        self._thread.start()

    def close(self) -> None:
        """End; no callback begins after this."""
        with self._wake:
            if self._closed:
                return
            self._closed = True
            self._wake.notify()
        if not self._session.is_closed():
            self._subscriber.undeclare()
        if threading.current_thread() is not self._thread:
            self._thread.join(END_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        with self._wake:
            self._waiting[str(sample.key_expr)] = sample
            self._wake.notify()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or bool(self._waiting))
                if self._closed:
                    return
                sample = self._waiting.pop(next(iter(self._waiting)))
            try:
                self._call_back(sample)
            except Exception:  # raised by the caller's function; later updates must still come
                logger.exception("the callback failed on an update of %s", sample.key_expr)

    def _call_back(self, sample: zenoh.Sample) -> None:
        try:
            tile = self._read(sample)
        except RoughMapError as error:
            if self._on_error is None:
                logger.warning("unreadable update: %s", error)
            else:
                self._on_error(error)
        else:
            self._callback(tile)
