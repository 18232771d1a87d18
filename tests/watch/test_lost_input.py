"""Robots whose data come to nothing, and a real service: who says so, in which words, and that it ends when mended."""

import json
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net import WAIT_S, wait_until
from processes import GROUND, LEVEL, PRECISE, T0, Feed, Service, running

from roughmap_schemas import encode_cloud, encode_odometry
from roughmap_schemas.messages import MapStatus
from roughmap_service.cli.main import run

TENTH = 10**8


class Robot:
    """One that stands and sends ten scans at a time, 0.1 s apart, with poses around them. Its clock never stands."""

    def __init__(self, feed: Feed, name: str) -> None:
        self.feed, self.name, self.stamp = feed, name, T0

    def send(
        self, *, frame: str = "map", covariance: np.ndarray = PRECISE, sensor: str = "lidar", ahead_s: float = 0.0
    ) -> None:
        for _ in range(10):
            for part in (0, TENTH // 2):
                pose = encode_odometry(self.stamp + part, frame, (0.0, 0.0, 0.0), LEVEL, covariance)
                self.feed.put("odometry", self.name, pose)
            stamp = self.stamp + TENTH // 4 + round(ahead_s * 1e9)
            self.feed.put("points", self.name, encode_cloud(GROUND, stamp, sensor))
            self.stamp += TENTH


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Feed]]:
    sensors = {'"os.lidar"': {"range_sigma": 0.01}, "lidar": {"range_sigma": 0.01}}
    with running(tmp_path_factory.mktemp("lost"), http={"listen": "127.0.0.1:0"}, sensors=sensors) as both:
        yield both


def page(service: Service, path: str) -> str:
    with urllib.request.urlopen(service.ready()["http"] + path, timeout=WAIT_S) as response:
        assert response.status == 200
        text: str = response.read().decode()
        return text


Send = Callable[[Robot], None]

CASES: dict[str, tuple[Send, Send, str, str]] = {
    "frame": (
        lambda robot: robot.send(frame="/map"),
        lambda robot: robot.send(),
        "robot frame",
        'their frame is "/map"; no transform is known; write their frame as "map"',
    ),
    "covariance": (
        lambda robot: robot.send(covariance=np.diag([0.09, 0.09, 1e-4, 1e-5, 1e-5, 1e-5])),
        lambda robot: robot.send(),
        "robot covariance sensor lidar",
        'cap it ([robots.covariance] pose_covariance = "cap")',
    ),
    "behind": (
        lambda robot: robot.send(sensor="os.lidar", ahead_s=-12.0),
        lambda robot: robot.send(sensor="os.lidar"),
        "robot behind sensor os.lidar",
        'or set time_offset = 12.0 in [sensors."os.lidar"]',
    ),
    "unknown": (
        lambda robot: robot.send(sensor="la/ser"),
        lambda robot: robot.send(),
        "robot unknown sensor la/ser",
        'add [sensors."la/ser"] with its translation, rotation and range_sigma',
    ),
}
"""What a robot of that name sends, what it sends when that is mended, who is told about, and what to do."""


@pytest.mark.parametrize("name", CASES)
def test_it_is_told_everywhere_in_the_same_words_and_ends_when_mended(
    name: str, live: tuple[Service, Feed], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "2000")
    service, feed = live
    lose, mend, subject, remedy = CASES[name]
    robot = Robot(feed, name)
    lose(robot)

    def sentence(status: MapStatus) -> str:
        return status.problems.get(subject, "")

    text = wait_until(lambda: sentence(feed.client.status()), "a problem")
    assert text.startswith(f"{subject}: ")
    assert remedy in text
    assert feed.client.status().health == "degraded"

    answer = json.loads(page(service, "/readyz"))
    assert answer["ready"] is True
    assert text in answer["problems"]["input_lost"].split("\n")
    quoted = text.replace("\\", "\\\\").replace('"', '\\"')
    assert f'roughmap_input_lost{{subject="{subject}",text="{quoted}"}} 1.0' in page(service, "/metrics").splitlines()

    def lines() -> list[tuple[str, str]]:
        told: list[dict[str, Any]] = [json.loads(line) for line in list(service.err) if line.startswith("{")]
        return [
            (line["event"], line["message"])
            for line in told
            if line.get("subject") == subject and line["event"] != "lost_some"
        ]

    assert wait_until(lines, "a log line") == [("stream_lost", text)]

    listen = service.ready()["http"].removeprefix("http://")
    assert run(["health", "--set", f"http.listen={listen}"]) == 0
    assert f"site: input_lost: {text}" in capsys.readouterr().out.splitlines()
    endpoint = f'zenoh.listen=["{service.ready()["endpoints"][0]}"]'
    for command in (["health", "--set", 'http.listen=""'], ["top", "--once"]):
        assert run([*command, "--set", endpoint]) == 0
        assert text in capsys.readouterr().out

    for _ in range(3):
        mend(robot)
    if name == "unknown":  # of that frame nothing comes any more; until it has been silent for long, the problem stands
        assert sentence(feed.client.status()) == text
        return
    wait_until(lambda: not sentence(feed.client.status()), "its end")
    wait_until(lambda: [event for event, _ in lines()] == ["stream_lost", "stream_restored"], "a log line of its end")
    assert f'subject="{subject}"' not in page(service, "/metrics")
