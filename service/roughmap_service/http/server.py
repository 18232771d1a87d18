"""The HTTP server: a socket, and a thread with an event loop of its own."""

import asyncio
import logging
import socket
import threading
from types import TracebackType
from typing import TYPE_CHECKING, Self

from roughmap_schemas.faults import ReportedError
from roughmap_schemas.sections import HttpConfig
from roughmap_service.host.exposure import is_loopback
from roughmap_service.http.token import HttpError, token_of
from roughmap_service.watch.readiness import Sources

if TYPE_CHECKING:
    import uvicorn

logger = logging.getLogger(__name__)

CLOSE_SECONDS = 1.5
"""Longest wait at shutdown: for running requests, and until uvicorn notices."""


class PortTaken(ReportedError):
    """The address can't be listened on now; a later start may find it free. The message is one line with the remedy."""


class HttpServer:
    """Serves the pages while it is entered; ``url`` has the real port.

    The socket is open from the start, so early requests wait for the event loop.

    Raises PortTaken if the socket can't be opened, and HttpError for an address other than loopback without a token,
    unless ``insecure``.
    """

    def __init__(self, http: HttpConfig, sources: Sources, *, insecure: bool = False) -> None:
        assert http.listen is not None  # noqa: S101 - otherwise there is nothing to serve
        host, _, port = http.listen.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        self._token = token_of(http)
        self._sources = sources
        self._on_loopback = is_loopback(host)
        if not self._on_loopback and self._token is None:
            if not insecure:
                raise HttpError(
                    f"http.listen: {http.listen} is open to the network without a token; set one "
                    "(http.token_file, or ROUGHMAP_HTTP__TOKEN), listen on 127.0.0.1, or start with --insecure"
                )
            logger.warning(
                "http.listen: %s: anyone on the network can read health and metrics (--insecure)", http.listen
            )
        elif not self._on_loopback:
            logger.warning(
                "http.listen: %s: pages and token cross the network unencrypted; use a TLS proxy", http.listen
            )
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, int(port)), family=family, backlog=64)
        except OSError as error:
            why = str(error.strerror or error).partition(" (")[0]
            raise PortTaken(
                f'http.listen: {http.listen}: {why}; set http.listen to another address, or to "" to serve no pages'
            ) from None
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._socket.getsockname()[1]}"
        self._server: uvicorn.Server | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="http", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        if self._server is not None:
            self._server.should_exit = True
        self._thread.join(CLOSE_SECONDS)
        self._socket.close()

    def _run(self) -> None:
        # Imported here: it takes a tenth of a second, in which the session opens and the map is recovered.
        from roughmap_service.http.access import Access  # noqa: PLC0415
        from roughmap_service.http.limits import make_server  # noqa: PLC0415
        from roughmap_service.http.pages import application  # noqa: PLC0415

        app = Access(application(self._sources), self._token, on_loopback=self._on_loopback)
        self._server = make_server(app)
        self._server.should_exit = self._ending.is_set()
        try:
            asyncio.run(self._server.serve(sockets=[self._socket]))
        except Exception:  # the map is served even without its pages
            logger.exception("the HTTP server failed; the service runs on without its pages")
