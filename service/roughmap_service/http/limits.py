"""uvicorn with the bounds that it lacks: of connections, and of how long one may be held."""

import asyncio
import socket
import struct
from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 64
"""A scraper, a probe and a few browsers; each connection costs a descriptor, which log and Zenoh need too."""

RESPONSE_SECONDS = 10.0
"""So long after it was opened, or after its last response, a connection must have asked and been answered."""

MAX_HEADERS = 16 << 10
"""Bytes of a request's line and headers."""


class BoundedProtocol(H11Protocol):
    """One connection: closed when no response completes in time, whoever is slow; and where there are too many, the one
    that was opened or answered the longest ago: who holds many open keeps out no probe, which is answered at once."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """As uvicorn, within the bounds."""
        super().connection_made(transport)
        self._arm()
        if len(self.connections) > MAX_CONNECTIONS:
            connections: set[Any] = {*self.connections}
            oldest = min(connections, key=lambda one: one._deadline.when())
            self.connections.discard(oldest)  # now, since its end is told later: many may come at once
            oldest._let_go()

    def on_response_complete(self) -> None:
        """As uvicorn; the next response has its own time."""
        self._arm()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """As uvicorn."""
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)

    def _arm(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = self.loop.call_later(RESPONSE_SECONDS, self._let_go)

    def _let_go(self) -> None:
        connection = self.transport.get_extra_info("socket")
        # Reset it: what was sent and never read would else stay in the kernel for as long as the other side pleases.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()


def make_server(app: Callable[..., Any]) -> uvicorn.Server:
    """A server of ``app`` with those bounds, quiet, and without a word on what it is."""
    return uvicorn.Server(
        uvicorn.Config(
            app, http=BoundedProtocol, ws="none", lifespan="off", loop="asyncio", interface="asgi3", log_config=None,
            log_level="warning", access_log=False, server_header=False, proxy_headers=False, timeout_keep_alive=5,
            timeout_graceful_shutdown=1, h11_max_incomplete_event_size=MAX_HEADERS,
        )
    )  # fmt: skip
