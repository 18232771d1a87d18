"""Clients that are slow, large or many: each is ended by its bound, and the others are answered."""

import pytest
from http_tools import get, open_raw, pages, rest

from roughmap_service.http import limits as http_limits
from roughmap_service.watch.readiness import Readiness, Sources


@pytest.mark.parametrize(
    "sent", [b"", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ", b"POST / HTTP/1.1\r\nContent-Length: 99\r\n"]
)
def test_who_does_not_finish_a_request_is_let_go(monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    monkeypatch.setattr(http_limits, "RESPONSE_SECONDS", 0.3)
    with pages() as server, open_raw(server, sent) as slow:
        assert get(server, "/healthz")[0] == 200
        assert rest(slow) == b"", "it is closed, without an answer"


def test_who_does_not_read_the_answer_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_limits, "RESPONSE_SECONDS", 0.3)
    large = 16 << 20  # more than the sockets' buffers hold
    sources = Sources(Readiness(), metrics=lambda: b"#" * large)
    with pages(sources) as server, open_raw(server, b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n") as slow:
        with open_raw(server) as idle:
            assert rest(idle) == b"", "by now the first one's time is over too"
        assert len(rest(slow)) < large
        assert get(server, "/healthz")[0] == 200


def test_headers_are_bounded() -> None:
    with pages() as server:
        with open_raw(server, b"GET /healthz HTTP/1.1\r\nX: " + b"x" * (http_limits.MAX_HEADERS + 1)) as large:
            assert rest(large).startswith(b"HTTP/1.1 4")
        with open_raw(server, b"\x16\x03\x01 no http at all\r\n\r\n") as other:
            assert rest(other).startswith(b"HTTP/1.1 400")
        assert get(server, "/healthz")[0] == 200


def test_connections_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_limits, "MAX_CONNECTIONS", 3)
    with pages() as server:
        held = [open_raw(server, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n") for _ in range(3)]
        try:
            assert all(one.recv(15) == b"HTTP/1.1 200 OK" for one in held)
            assert get(server, "/healthz")[0] == 200, "who holds all that there may be keeps no probe out"
            assert rest(held[0]).endswith(b'{"alive":true}'), "the oldest one is closed in its place"
            held[1].sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert held[1].recv(200)
        finally:
            for one in held:
                one.close()


def test_requests_one_after_the_other_on_one_connection() -> None:
    with pages() as server:
        ask = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
        last = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        with open_raw(server, ask + ask + last) as connection:
            assert rest(connection).count(b'{"alive":true}') == 3
