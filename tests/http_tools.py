"""The pages behind a real socket on loopback, and a plain client that returns every byte."""

import http.client
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from net import WAIT_S

from roughmap_schemas.sections import HttpConfig
from roughmap_service.http.server import HttpServer
from roughmap_service.watch.readiness import Readiness, Sources


@contextmanager
def pages(sources: Sources | None = None, **settings: Any) -> Iterator[HttpServer]:
    """Start a server on a port that the system chooses."""
    config = HttpConfig.model_validate({"listen": "127.0.0.1:0", **settings})
    with HttpServer(config, sources or Sources(Readiness())) as server:
        yield server


def address(server: HttpServer) -> tuple[str, int]:
    """Return its address."""
    parts = urlsplit(server.url)
    assert parts.hostname is not None
    assert parts.port is not None
    return parts.hostname, parts.port


def get(
    server: HttpServer, path: str, method: str = "GET", body: bytes | None = None, **headers: str
) -> tuple[int, Mapping[str, str], bytes]:
    """Make one request; return status, headers (names in lower case) and body."""
    connection = http.client.HTTPConnection(*address(server), timeout=WAIT_S)
    try:
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        return response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()
    finally:
        connection.close()


def open_raw(server: HttpServer, sent: bytes = b"") -> socket.socket:
    """Open a connection and send these bytes."""
    connection = socket.create_connection(address(server), WAIT_S)
    connection.sendall(sent)
    return connection


def rest(connection: socket.socket) -> bytes:
    """Return all bytes until the other side closes."""
    found = b""
    try:
        while piece := connection.recv(65536):
            found += piece
    except ConnectionResetError:
        pass
    return found
