"""`roughmap health` by the readiness page: which problems are a failure, and what is said when nobody answers."""

import json
import socket
import threading
from pathlib import Path

import pytest
from http_tools import pages
from net import locators
from served import Served

from roughmap_schemas.messages import LogState
from roughmap_service.cli.main import run
from roughmap_service.inputs.streams import MAX_PROBLEMS
from roughmap_service.watch.readiness import Problem, Readiness, Sources, health_of, running_problems, told
from roughmap_service.watch.status import RunProgress

TOKEN = "the token of this page"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def health(listen: str, *arguments: str) -> int:
    return run(["health", "--set", f"http.listen={listen}", *arguments])


@pytest.mark.parametrize("problem", [None, *Problem])
def test_what_the_service_works_with_is_no_failure_and_all_else_is(
    problem: Problem | None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    readiness = Readiness()
    readiness.become(lambda: {problem: "for a cause"} if problem else {})
    monkeypatch.setenv("ROUGHMAP_HTTP__TOKEN", TOKEN)
    with pages(Sources(readiness), token=TOKEN) as server:
        code = health(server.url.removeprefix("http://"))
    assert code == (0 if problem in (None, Problem.OVERLOADED, Problem.SNAPSHOT_FAILED, Problem.INPUT_LOST) else 1)
    assert capsys.readouterr().out == f"site: {problem}: for a cause\n" if problem else "site: ok\n"


def test_what_happened_lately_is_no_failure(capsys: pytest.CaptureFixture[str]) -> None:
    readiness = Readiness()
    readiness.become(dict)
    sources = Sources(readiness, recent=lambda: ["robot r1: its pose leapt 2.50 m (3 s ago)"])
    with pages(sources) as server:
        where = server.url.removeprefix("http://")
        assert (health(where), health(where, "--json")) == (0, 0)
    first, second, as_json = capsys.readouterr().out.splitlines()
    assert (first, second) == ("site: ok", "site: recently: robot r1: its pose leapt 2.50 m (3 s ago)")
    assert json.loads(as_json)["recent"] == ["robot r1: its pose leapt 2.50 m (3 s ago)"]


GROWING = LogState(bytes_per_hour=3_200_000_000, hours_to_full_disk=41.2)
BOUNDED = LogState(bytes_per_hour=3_200_000_000, keep=20_000_000_000)


@pytest.mark.parametrize(
    ("log", "said"),
    [
        (LogState(), []),
        (GROWING, ["site: log: 3.2 GB an hour, the disk is full in 41 hours"]),
        (BOUNDED, ["site: log: 3.2 GB an hour, bounded to 20.0 GB by log.keep"]),
    ],
)
def test_what_the_log_costs_is_told_last(log: LogState, said: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """By the page and over Zenoh alike."""
    readiness = Readiness()
    readiness.become(dict)
    with Served() as served, pages(Sources(readiness, log=lambda: log)) as server:
        served.progress = RunProgress(log=log)
        by_zenoh = ["--set", f'zenoh.listen=["{locators(served.server)[0]}"]']
        for where, more in ((server.url.removeprefix("http://"), []), ('""', by_zenoh)):
            assert health(where, *more) == 0
            assert capsys.readouterr().out.splitlines() == ["site: ok", *said]
            assert health(where, *more, "--json") == 0
            told = json.loads(capsys.readouterr().out)["log"]
            assert told == {
                "bytes_per_hour": log.bytes_per_hour, "hours_to_full_disk": log.hours_to_full_disk, "keep": log.keep,
            }  # fmt: skip


def test_nobody_there_is_a_failure_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    assert health(f"127.0.0.1:{port}") == 1
    assert (
        capsys.readouterr().out == f"site: not_there: nobody answers on http://127.0.0.1:{port} (Connection refused)\n"
    )


@pytest.mark.parametrize(
    "answer", [b"220 a mail server\r\n", b"HTTP/1.1 200 OK\r\n\r\n<html>", b"HTTP/1.1 200 OK\r\n\r\n[]"]
)
def test_another_program_on_the_port_is_no_service(answer: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:

        def serve() -> None:
            connection, _ = other.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        assert health(f"127.0.0.1:{other.getsockname()[1]}", "--json") == 1
        thread.join()
    assert "roughmap service" in json.loads(capsys.readouterr().out)["problems"]["not_there"]


LOST = {
    "robot r1": "robot r1: none of its last 10 poses was taken: all have one stamp",
    "robot r1 sensor os.lidar": "robot r1 sensor os.lidar: none of its last 10 clouds was mapped: they are late",
}


@pytest.mark.parametrize("problem", [None, *(p for p in Problem if p not in (Problem.STARTING, Problem.SHUTTING_DOWN))])
def test_over_zenoh_it_says_what_the_page_says(
    problem: Problem | None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two problems of the sequencer, which needs a restart either way, have one subject there."""
    lost = LOST if problem is Problem.INPUT_LOST else {}
    problems = {} if problem is None else {problem: "\n".join(lost.values()) or "a cause"}
    readiness = Readiness()
    readiness.become(lambda: problems)
    monkeypatch.setenv("ROUGHMAP_HTTP__TOKEN", TOKEN)
    with Served() as served, pages(Sources(readiness), token=TOKEN) as server:
        served.progress = RunProgress(problems=problems, lost=lost, log=LogState())
        by_page = health(server.url.removeprefix("http://"))
        said = capsys.readouterr().out
        assert health('""', "--set", f'zenoh.listen=["{locators(served.server)[0]}"]') == by_page
    assert capsys.readouterr().out.replace("stalled", "dead") == said.replace("stalled", "dead")
    assert len(said.splitlines()) == (2 if lost else 1)


def test_a_status_lists_at_most_32_problems_those_of_the_service_first() -> None:
    lost = {f"robot r{number}": "a sentence" for number in range(40)}
    listed = told({Problem.OVERLOADED: "a cause", Problem.INPUT_LOST: "all"}, lost)
    assert len(listed) == MAX_PROBLEMS == 32
    assert list(listed)[:2] == ["overload", "robot r0"]
    assert "10 more" in listed["others"]
    assert told({}, {}) == {}


def test_what_a_running_service_can_suffer_from() -> None:
    well = {
        "alive": True,
        "turned": float("inf"),
        "failure": None,
        "log_ok": True,
        "log_error": "",
        "memory_ok": True,
        "store_ok": True,
        "store_error": "",
        "overloaded": False,
    }

    def found(**changed: object) -> dict[Problem, str]:
        return running_problems(**{**well, **changed})  # type: ignore[arg-type]

    assert found() == {}
    assert list(found(alive=False, failure=ValueError("a cause"))) == [Problem.SEQUENCER_DEAD]
    assert "a cause" in found(alive=False, failure=ValueError("a cause"))[Problem.SEQUENCER_DEAD]
    assert list(found(turned=float("-inf"))) == [Problem.SEQUENCER_STALLED]
    assert "map.db: no room" in found(store_ok=False, store_error="map.db: no room")[Problem.SNAPSHOT_FAILED]
    assert found(lost=["one", "two"]) == {Problem.INPUT_LOST: "one\ntwo"}
    all_four = [Problem.LOG_NOT_WRITABLE, Problem.MEMORY_FULL, Problem.SNAPSHOT_FAILED, Problem.OVERLOADED]
    assert list(found(log_ok=False, memory_ok=False, store_ok=False, overloaded=True)) == all_four


def test_of_the_words_for_health_an_overload_is_the_weaker() -> None:
    assert (health_of([]), health_of([Problem.OVERLOADED])) == ("ok", "overloaded")
    for problem in set(Problem) - {Problem.OVERLOADED}:
        assert health_of([problem]) == health_of([Problem.OVERLOADED, problem]) == "degraded"
