"""What a service says while the disk of its log or of its store fails, and when it is well again: status, pages,
metrics, log lines, `roughmap health`."""

import json
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import paths  # noqa: F401 - before what it makes importable
import pytest
from load import dense
from net import Gathered, wait_until
from processes import T0, Feed, Service, connected
from shim import Shim

from roughmap_schemas import MapStatus, encode_cloud
from roughmap_service.cli.main import run


def placed(number: int) -> bytes:
    return encode_cloud([[0.05, 0.05 + number, 1.0]], T0 + number, "map")


class Sick:
    """A service with pages whose log and store lie on a disk that may fail, and a session that follows its health."""

    def __init__(self, service: Service, feed: Feed) -> None:
        self.service = service
        self.feed = feed
        self.url = service.ready()["http"]
        self._told: Gathered[str] = Gathered()
        feed.session.declare_subscriber(
            "maps/site/status", lambda s: self._told(MapStatus.model_validate_json(s.payload.to_bytes()).health)
        )

    def becomes(self, health: str) -> None:
        self._told.wait(lambda items: items[-1:] == [health], f"the health to be {health}")

    def readyz(self) -> tuple[int, dict[str, str]]:
        try:
            with urllib.request.urlopen(f"{self.url}/readyz", timeout=30) as answer:
                return answer.status, json.loads(answer.read())["problems"]
        except urllib.error.HTTPError as refused:
            with refused:
                return refused.code, json.loads(refused.read())["problems"]

    def metric(self, name: str) -> float:
        with urllib.request.urlopen(f"{self.url}/metrics", timeout=30) as answer:
            lines = answer.read().decode().splitlines()
        return next(float(line.rpartition(" ")[2]) for line in lines if line.rpartition(" ")[0] == f"roughmap_{name}")

    def health(self) -> int:
        return run(["health", "--set", f"http.listen={self.url.removeprefix('http://')}"])

    def events(self) -> list[str]:
        lines: list[dict[str, Any]] = [json.loads(line) for line in self.service.err]
        told = ("degraded", "recovered", "snapshot_failed", "snapshot_recovered", "stalled", "stall_ended")
        return [line["event"] for line in lines if line.get("event") in told]


Start = Callable[..., Any]


@pytest.fixture
def shim(tmp_path: Path) -> Shim:
    return Shim(tmp_path / "shim")


@pytest.fixture
def start(tmp_path: Path, shim: Shim, monkeypatch: pytest.MonkeyPatch) -> Start:
    monkeypatch.chdir(tmp_path)

    @contextmanager
    def started(**settings: Any) -> Iterator[Sick]:
        given = {"store": {"path": str(shim.root / "store" / "map.db"), "snapshot_interval": 0.2}, **settings}
        with Service(
            tmp_path, environ=shim.environ, log={"directory": str(shim.root / "log")}, http={"listen": "127.0.0.1:0"},
            **given,
        ) as service, connected(service) as feed:  # fmt: skip
            yield Sick(service, feed)
            assert service.stop() == 0, service.err[-3:]

    return started


def test_a_store_that_fails_is_reported_and_holds_up_nothing(
    shim: Shim, start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    with start() as sick:
        feed: Feed = sick.feed
        sick.becomes("ok")
        with shim.failing("write", "sync", "open", only="store"):
            feed.decided(feed.ingest("points", "r1", placed(1)).input)
            sick.becomes("degraded")
            code, problems = sick.readyz()
            assert (code, list(problems)) == (200, ["snapshot_failed"]), "it takes in and answers"
            assert str(shim.root / "store" / "map.db") in problems["snapshot_failed"]
            assert sick.health() == 0, "a restart would better nothing"
            assert capsys.readouterr().out.startswith("site: snapshot_failed: the store can't be written: ")
            assert [sick.metric(name) for name in ("ready", "snapshot_ok", 'problem{problem="snapshot_failed"}')] == [
                1,
                0,
                1,
            ]
            assert sick.metric('health{state="degraded"}') == 1
            assert feed.decided(feed.ingest("points", "r1", placed(2)).input).outcome == "integrated"
            status = feed.client.status()
            assert (status.health, status.log.ok, status.refused) == ("degraded", True, {})
        sick.becomes("ok")
        assert sick.readyz() == (200, {})
        assert sick.metric("snapshot_ok") == 1
    assert sick.events() == ["snapshot_failed", "snapshot_recovered"]


def test_a_disk_that_hangs_is_reported_and_refused_for(shim: Shim, start: Start) -> None:
    """Nothing is acknowledged until it answers, and once it is seen nothing is taken in; what waited is whole then."""
    with start() as sick:
        feed: Feed = sick.feed
        sequence = feed.decided(feed.ingest("points", "r1", placed(1)).input).sequence
        late: Gathered[Any] = Gathered()
        with shim.hanging():
            feed.send("points", "r1", placed(2), late)
            sick.becomes("degraded")
            code, problems = sick.readyz()
            assert code == 503
            assert "its disk has not answered for 10 s" in problems["log_not_writable"]
            assert sick.health() == 1
            assert sick.metric("log_ok") == 0
            assert feed.refused("points", "r1", placed(3)) == "log_unavailable"
            assert feed.client.region((0, 0, 1, 3)).known_cells > 0, "queries go on"
            assert late.items == ["log_unavailable"]
            assert feed.refused("points", "r1", placed(2)) == "log_unavailable", "nor the same bytes again"
        sick.becomes("ok")
        receipt = feed.ingest("points", "r1", placed(2))
        assert receipt.duplicate
        assert late.items == ["log_unavailable"], "a request has one answer"
        assert feed.decided(receipt.input).outcome == "integrated"
        assert feed.decided(feed.ingest("points", "r1", placed(3)).input).sequence == sequence + 2
    assert sick.events() == ["degraded", "recovered"]


def test_a_spill_file_that_hangs_is_reported_and_only_the_map_waits(shim: Shim, start: Start) -> None:
    """The sequencer needs room for a cloud and waits for it: the queue's limit answers requests; queries go on."""
    spill = {"memory_limit": "8MiB", "spill_path": str(shim.root / "tiles.spill")}
    small = {"queue_limit": "8MiB", "max_message": "8MiB"}
    answers: Gathered[Any] = Gathered()
    with start(map=spill, input=small, store={}) as sick:
        feed: Feed = sick.feed
        with shim.hanging(syncs=False, writes=True, only="store"):  # all that is not the log
            for number in range(2):
                feed.put("points", "r1", dense(number))
            sick.becomes("degraded")
            assert list(sick.readyz()[1]) == ["sequencer_stalled"]
            assert feed.client.region((0, 0, 1, 1)).known_cells == 100, "queries go on"
            for number in range(2, 5):
                feed.send("points", "r1", dense(number), answers)
            answers.wait(lambda items: "busy" in items, "a request that finds no room")
            wait_until(lambda: sick.events() == ["stalled"], "the log line on the stall")
        sick.becomes("ok")
        answers.wait(lambda items: len(items) == 3, "the receipts of those that found room")
        assert feed.decided(feed.ingest("points", "r1", placed(1)).input).outcome == "integrated"
        wait_until(lambda: sick.events() == ["stalled", "stall_ended"], "the log line on its end")
