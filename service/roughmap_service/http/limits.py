"""uvicorn with two bounds that it lacks: the number of connections, and how long one may be held."""

import asyncio
import socket
import struct
from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 64
"""Enough for a scraper, a probe and a few browsers. Each connection takes a file descriptor, and the log and Zenoh
need them too."""

RESPONSE_SECONDS = 10.0
"""A connection is closed if it completes no response for this long."""

MAX_HEADERS = 16 << 10
"""Largest request line and headers, in bytes."""


class BoundedProtocol(H11Protocol):
    """One connection, closed if no response completes in time.

    If there are too many connections, the one that was opened or answered the longest ago is closed. So a client that
    holds many open cannot keep out a probe, which is answered at once.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection, and close the oldest one if there are too many."""
        super().connection_made(transport)
        self._arm()
        if len(self.connections) > MAX_CONNECTIONS:
            connections: set[Any] = {*self.connections}
            oldest = min(connections, key=lambda one: one._deadline.when())
            self.connections.discard(oldest)  # now: its end is reported later, and many may come at once
            oldest._let_go()

    def on_response_complete(self) -> None:
        """Start the time for the next response."""
        self._arm()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the time."""
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _arm(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = self.loop.call_later(RESPONSE_SECONDS, self._let_go)

    def _let_go(self) -> None:
        connection = self.transport.get_extra_info("socket")
        # Reset it: otherwise the kernel would keep unread data for as long as the client likes.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()


def make_server(app: Callable[..., Any]) -> uvicorn.Server:
    """Return a server of ``app`` with these bounds, without access log and without a Server header."""
    return uvicorn.Server(
        uvicorn.Config(
            app, http=BoundedProtocol, ws="none", lifespan="off", loop="asyncio", interface="asgi3", log_config=None,
            log_level="warning", access_log=False, server_header=False, proxy_headers=False, timeout_keep_alive=5,
            timeout_graceful_shutdown=1, h11_max_incomplete_event_size=MAX_HEADERS,
        )
    )  # fmt: skip
