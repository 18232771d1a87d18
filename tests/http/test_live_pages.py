"""A service that runs: its pages, its log lines, `health` and `top`, beside the status that it gives over Zenoh."""

import json
import shutil
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net import Gathered, wait_until
from processes import LEVEL, PRECISE, READY_S, T0, Feed, Service, connected, read_log

from roughmap_schemas import MapStatus, encode_cloud, encode_odometry
from roughmap_service.cli.main import run

TOKEN = "never to be seen anywhere"


@dataclass
class Running:
    """A service, a session with it, and where it is."""

    service: Service
    feed: Feed
    url: str
    endpoint: str

    def page(self, path: str) -> bytes:
        request = urllib.request.Request(self.url + path, headers={"Authorization": f"Bearer {TOKEN}"})
        with urllib.request.urlopen(request, timeout=30) as response:
            body: bytes = response.read()
            return body

    def metric(self, name: str) -> float:
        lines = self.page("/metrics").decode().splitlines()
        return next(float(line.rpartition(" ")[2]) for line in lines if line.rpartition(" ")[0] == name)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """One cloud integrated, one refused, three messages missing."""
    folder = tmp_path_factory.mktemp("watch")
    (folder / "token").write_text(TOKEN)
    http = {"listen": "127.0.0.1:0", "token_file": str(folder / "token")}
    with Service(folder, http=http, log={"directory": str(folder / "log"), "max_file_age": 3600}) as service:
        ready = service.ready()
        with connected(service) as feed:
            for n, number in enumerate([*range(1, 10), 13]):
                pose = encode_odometry(T0 + n * 10**8, "map", (0.0, 0.0, 0.0), LEVEL, PRECISE)
                feed.put("odometry", "rover1", pose, attachment=number.to_bytes(8, "little"))
            feed.decided(feed.cloud("rover1", T0 + 5 * 10**7))
            feed.refused("points", "rover1", b"no cloud")
            feed.settle()
            yield Running(service, feed, ready["http"], ready["endpoints"][0])


def test_the_pages_say_what_the_status_says(live: Running) -> None:
    status = live.feed.client.status()
    page = json.loads(live.page("/readyz"))
    assert (page["ready"], page["problems"]) == (True, {})
    assert len(page["recent"]) == len(status.recent) == 2
    refused, gap = status.recent
    assert gap.startswith("robot rover1: 3 of its odometry messages were lost on the way so far; publish with")
    assert refused.startswith("robot rover1: its last cloud was not taken: ")
    assert live.metric("roughmap_points_accepted_total") == status.points.accepted == 4
    assert live.metric('roughmap_messages_refused_total{reason="bad_message"}') == status.refused["bad_message"]
    assert live.metric('roughmap_messages_missing_total{robot="rover1"}') == status.gaps["rover1"] == 3
    assert live.metric("roughmap_sequence") == status.sequence == 1
    assert live.metric("roughmap_integration_seconds_count") == live.metric("roughmap_lag_seconds_count") == 1
    assert live.metric("roughmap_log_sync_seconds_count") > 0
    assert live.metric("roughmap_disk_bytes" + '{what="log"}') > 0
    before = live.metric('roughmap_query_seconds_count{outcome="ok"}')
    live.feed.client.region((0, 0, 1, 1), ["mean_height"])
    wait_until(  # it is counted once its last reply is out, when the asker may have it already
        lambda: live.metric('roughmap_query_seconds_count{outcome="ok"}') == before + 1, "the query to be counted"
    )
    assert b"<h1>roughmap" in live.page("/")


def test_what_the_log_costs_is_told_once_it_is_known(
    live: Running, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the status, the page, the metrics, `health` and `top`; by then the service has run for 10 s."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROUGHMAP_HTTP__TOKEN", TOKEN)
    wait_until(lambda: live.feed.client.status().log.bytes_per_hour is not None, "the log's growth")
    status = live.feed.client.status()
    assert status.uptime_s >= 10.0
    page = json.loads(live.page("/readyz"))["log"]
    assert page["keep"] is status.log.keep is None
    assert page["bytes_per_hour"] >= 0
    assert live.metric("roughmap_log_bytes_per_hour") >= 0
    if page["bytes_per_hour"]:
        free = shutil.disk_usage(tmp_path).free
        assert page["hours_to_full_disk"] == pytest.approx(free / page["bytes_per_hour"], rel=0.1)
    for command, more, listen in (("health", (), live.url.removeprefix("http://")), ("top", ("--once",), '""')):
        assert asked(live, command, *more, listen=listen) == 0
        assert " an hour" in capsys.readouterr().out


def asked(live: Running, command: str, *arguments: str, listen: str) -> int:
    return run([command, *arguments, "--set", f'zenoh.listen=["{live.endpoint}"]', "--set", f"http.listen={listen}"])


def test_health_asks_the_page_or_over_zenoh(
    live: Running, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for listen in (live.url.removeprefix("http://"), '""', "127.0.0.1:0"):
        assert asked(live, "health", listen=listen) == 0
        first, *rest = capsys.readouterr().out.splitlines()
        assert first == "site: ok", listen
        assert all(line.startswith(("site: recently: robot rover1: ", "site: log: ")) for line in rest)
    assert asked(live, "health", "--set", "map.name=other", "--json", listen='""') == 1
    told = json.loads(capsys.readouterr().out)
    assert told["works"] is False
    assert "is the map 'other' served there?" in told["problems"]["not_there"]


def test_top_prints_a_frame(
    live: Running, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    assert asked(live, "top", "--once", listen='""') == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0][:4] == ["site", "ok", "sequence", "1"]
    assert ["points", "0", "4", "0"] in lines
    assert ["refused", "1", "bad_message", "not", "a", "valid", "message"] in lines
    assert ["rover1", "0.0", "0", "0", "0", "3", "0"] in lines, "a robot of which only a gap is known"
    assert asked(live, "top", "--once", "--json", listen='""') == 0
    assert MapStatus.model_validate_json(capsys.readouterr().out).points.accepted == 4
    assert asked(live, "top", "--once", "--map", "other", "--timeout", "0.3", listen='""') == 1
    assert "is the map 'other' served there?" in capsys.readouterr().err


def test_log_lines_tell_the_events_and_nothing_tells_the_token(live: Running) -> None:
    assert live.service.stop() == 0
    lines: list[dict[str, Any]] = [json.loads(line) for line in live.service.err]
    told = {line["event"]: line for line in lines if line.get("event") not in (None, "compiling")}  # if loading is slow
    assert list(told) == ["start", "map_recovered", "ready", "robot", "gap", "refused", "shutdown", "end"]
    assert told["ready"]["http"] == live.url
    assert (told["gap"]["robot"], told["gap"]["missing"]) == ("rover1", 3)
    assert (told["shutdown"]["points"], told["shutdown"]["refused"]) == (4, {"bad_message": 1})
    assert told["end"]["signal"] == "SIGTERM"
    assert read_log(live.service.log)
    kept = b"".join(path.read_bytes() for path in live.service.log.glob("*.mcap"))
    assert TOKEN.encode() not in kept
    assert not any(TOKEN in line for line in [*live.service.out, *live.service.err])


def test_an_overload_is_reported_everywhere_and_so_is_its_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clouds whose poses never come fill a small inbox."""
    monkeypatch.chdir(tmp_path)
    cloud = [encode_cloud(np.full((100, 3), k, np.float32), T0 + k, "lidar") for k in range(200)]
    inputs = {"max_message": 20_000, "queue_limit": 20_000, "max_wait": 600.0}
    with Service(tmp_path, http={"listen": "127.0.0.1:0"}, input=inputs) as service:
        listen = service.ready()["http"].removeprefix("http://")
        with connected(service) as feed:
            while True:  # until more is dropped than may wait: at the latest when all are sent
                feed.put("points", "rover1", cloud.pop())
                if feed.settle().health == "overloaded":
                    break
            assert run(["health", "--set", f"http.listen={listen}"]) == 0, "it works, as well as it can"
            assert capsys.readouterr().out.startswith(
                "site: overloaded: input arrives faster than it can be integrated"
            )
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(f"http://{listen}/readyz", timeout=30)
            refused.value.close()
            assert refused.value.code == 503
            statuses: Gathered[MapStatus] = Gathered()
            feed.session.declare_subscriber(
                "maps/site/status", lambda sample: statuses(MapStatus.model_validate_json(sample.payload.to_bytes()))
            )
            statuses.wait(lambda all_: all_[-1:] != [] and all_[-1].health == "ok", "the overload's end")
        assert service.stop() == 0
    told = [line for line in map(json.loads, service.err) if str(line.get("event")).startswith("overload")]
    assert [line["event"] for line in told] == ["overload_begun", "overload_ended"]
    assert told[1]["dropped"] >= 1


def test_a_start_that_would_open_the_pages_to_the_network_is_refused(tmp_path: Path) -> None:
    with Service(tmp_path, http={"listen": "0.0.0.0:0"}) as service:
        assert service.finished(READY_S) == 2
        (line,) = [line for line in service.err if not line.startswith("{")]
        assert "http.listen: 0.0.0.0:0 is open to the network" in line
