"""What the pages say, to whom, and what they refuse."""

import base64
import json
import socket
from pathlib import Path

import pytest
from http_tools import address, get, pages

from roughmap_schemas.sections import HttpConfig
from roughmap_service.http.server import HttpError, HttpServer, PortTaken
from roughmap_service.watch.readiness import Problem, Readiness, Sources

TOKEN = "a token of twenty-four"
UNKNOWN = {"bytes_per_hour": None, "hours_to_full_disk": None, "keep": None}


def sources_with(problems: dict[Problem, str]) -> Sources:
    readiness = Readiness()
    readiness.become(lambda: problems)
    return Sources(readiness, metrics=lambda: b"roughmap_ready 1\n")


def test_before_it_is_ready_it_is_alive_and_says_that_it_starts() -> None:
    with pages() as server:
        assert get(server, "/healthz")[0] == 200
        status, _, body = get(server, "/readyz")
        assert (status, json.loads(body)["problems"]) == (503, {"starting": "the map is being recovered"})
        assert get(server, "/metrics")[0] == get(server, "/")[0] == 503


@pytest.mark.parametrize("problem", Problem)
def test_readiness_names_what_is_wrong(problem: Problem) -> None:
    problems = {problem: "the cause"}
    with pages(sources_with(problems)) as server:
        status, headers, body = get(server, "/readyz")
        ready = problem in (Problem.SNAPSHOT_FAILED, Problem.INPUT_LOST)  # it takes in and answers all the same
        assert status == (200 if ready else 503)
        assert headers["content-type"] == "application/json"
        found = {"problems": {str(problem): "the cause"}, "recent": [], "log": UNKNOWN}
        assert json.loads(body) == {"ready": ready, **found}
        problems.clear()
        status, _, body = get(server, "/readyz")
        assert (status, json.loads(body)) == (200, {"ready": True, "problems": {}, "recent": [], "log": UNKNOWN})


def test_every_answer_carries_the_headers_and_none_says_what_serves_it() -> None:
    with pages(sources_with({})) as server:
        for path, method in (("/healthz", "GET"), ("/metrics", "HEAD"), ("/nowhere", "GET"), ("/metrics", "POST")):
            _, headers, _ = get(server, path, method)
            assert headers["x-content-type-options"] == "nosniff", path
            assert headers["cache-control"] == "no-store", path
            policy = headers["content-security-policy"]
            assert "default-src 'none'" in policy
            assert "frame-ancestors 'none'" in policy
            assert "server" not in headers, path


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT"])
def test_only_get_and_head(method: str) -> None:
    with pages(sources_with({})) as server:
        status, headers, _ = get(server, "/metrics", method)
        assert (status, headers["allow"]) == (405, "GET, HEAD")


def test_head_has_no_body_and_a_request_may_have_none() -> None:
    with pages(sources_with({})) as server:
        status, headers, body = get(server, "/metrics", "HEAD")
        assert (status, body, headers["content-length"]) == (200, b"", str(len(b"roughmap_ready 1\n")))
        assert get(server, "/metrics", body=b"x" * 100)[0] == 413


@pytest.mark.parametrize(
    "path",
    ["/../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/metrics/../../etc/passwd", "//etc/passwd", "/metrics/", "/%00",
     "/..%5c..%5cetc%5cpasswd"],
)  # fmt: skip
def test_no_path_leads_anywhere_else(path: str) -> None:
    with pages(sources_with({})) as server:
        status, headers, body = get(server, path)
        assert (status, body) == (404, b"Not Found")
        assert "location" not in headers


def test_without_a_token_only_the_names_of_this_machine_are_answered() -> None:
    with pages(sources_with({})) as server:
        for name in ("localhost:8080", "127.0.0.1", "[::1]:1"):
            assert get(server, "/metrics", Host=name)[0] == 200, name
        for name in ("evil.example", "localhost.evil.example:8080", "192.0.2.1", "[", ""):
            assert get(server, "/metrics", Host=name)[0] == 421, name


def test_a_token_is_needed_for_all_but_health(tmp_path: Path) -> None:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    basic = base64.b64encode(f"anyone:{TOKEN}".encode()).decode()
    with pages(sources_with({Problem.OVERLOADED: "cause"}), token_file=str(tmp_path / "token")) as server:
        for shown in (f"Bearer {TOKEN}", f"bearer {TOKEN}", f"Basic {basic}"):
            assert get(server, "/metrics", Authorization=shown)[0] == 200, shown
        for shown in (
            "",
            TOKEN,
            f"Bearer {TOKEN}x",
            f"Bearer {TOKEN[:-1]}",
            "Bearer ",
            "Basic !",
            "Basic Og==",
            "Other x",
        ):
            status, headers, body = get(server, "/metrics", Authorization=shown)
            assert (status, "basic" in headers["www-authenticate"].lower()) == (401, True), shown
            assert TOKEN.encode() not in body
        assert get(server, "/nowhere")[0] == 401, "who may not look isn't told what is there"
        assert get(server, "/healthz")[0] == 200
        assert json.loads(get(server, "/readyz")[2])["problems"] == {"overloaded": ""}, "causes are for who may look"


def test_the_network_sees_nothing_without_a_token(tmp_path: Path) -> None:
    sources = sources_with({})
    with pytest.raises(HttpError, match=r"http.listen: 0.0.0.0:0 is open to the network without a token.*--insec"):
        HttpServer(HttpConfig(listen="0.0.0.0:0"), sources)
    with HttpServer(HttpConfig.model_validate({"listen": "0.0.0.0:0", "token": TOKEN}), sources) as server:
        assert get(server, "/metrics")[0] == 401
    with HttpServer(HttpConfig(listen="0.0.0.0:0"), sources, insecure=True) as server:
        assert get(server, "/metrics", Host="robot7:8080")[0] == 200
    with pytest.raises(HttpError, match="No such file"):
        HttpServer(HttpConfig(listen="0.0.0.0:0", token_file=str(tmp_path / "none")), sources)
    (tmp_path / "empty").write_text("\n")
    with pytest.raises(HttpError, match="is empty"):
        HttpServer(HttpConfig(listen="0.0.0.0:0", token_file=str(tmp_path / "empty")), sources)


def test_a_port_that_is_taken_is_one_line() -> None:
    with pages() as server, pytest.raises(PortTaken, match=r"Address already in use; set http.listen to another"):
        HttpServer(HttpConfig(listen=f"127.0.0.1:{address(server)[1]}"), Sources(Readiness()))


def test_its_end_frees_the_port() -> None:
    with pages() as server:
        where = address(server)
        get(server, "/healthz")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(where)
