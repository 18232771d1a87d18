"""A sensor that a transform mounts, with the service as it runs: its map, its counts, and a start after a kill."""

from pathlib import Path
from typing import Any

import pytest
from processes import LEVEL, T0, Feed, Service, connected, replay

from roughmap_schemas import encode_transform

S = 10**9
SENSORS = {"lidar": {"range_sigma": 0.01, "extrinsics": "transform"}}
AHEAD = [[1.0, 0.0, -1.0]] * 2
"""Two returns from one spot: one alone is not yet ground."""


def settings(directory: Path, store: bool) -> dict[str, Any]:
    sections: dict[str, Any] = {
        "sensors": SENSORS,
        "input": {"max_wait": 0.3},
        "log": {"directory": str(directory / "log")},
    }
    return {**sections, "store": {"path": str(directory / "map.db")}} if store else sections


def scan(feed: Feed, robot: str, tenth: int) -> str:
    """A scan from x = 0, y = `tenth` m, 5 m up; its outcome."""
    for t in (tenth, tenth + 1):
        feed.pose(robot, T0 + t * S // 10, (0.05, 0.05 + tenth, 5.0))
    return str(feed.decided(feed.cloud(robot, T0 + tenth * S // 10 + S // 20, AHEAD)).outcome)


def height(feed: Feed, x: float, y: float) -> float:
    return float(feed.client.cells([(x, y)])["mean_height"][0])


@pytest.mark.parametrize("store", [False, True], ids=["by the log", "by the store"])
def test_the_mounting_that_came_holds_after_a_kill(tmp_path: Path, store: bool) -> None:
    sections = settings(tmp_path, store)
    with Service(tmp_path, **sections) as service, connected(service) as feed:
        assert scan(feed, "r1", 0) == "no_extrinsics"
        feed.ingest("transform", "r1", encode_transform(0, "base_link", "lidar", (2.0, 0.0, 0.5), LEVEL))
        assert scan(feed, "r1", 2) == "integrated"
        status = feed.settle()
        assert status.clouds.rejected == {"no_extrinsics": 1}
        assert status.poses.rejected == {}
        assert any("its mounting came: base_link -> lidar at 2, 0, 0.5 m" in text for text in status.recent)
        assert height(feed, 3.05, 2.05) == 4.5
        service.kill()
    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            assert height(feed, 3.05, 2.05) == 4.5
            assert scan(feed, "r1", 4) == "integrated"
            assert height(feed, 3.05, 4.05) == 4.5
            assert scan(feed, "r2", 4) == "no_extrinsics", "each robot has its own"
        assert service.stop() == 0
    code, text = replay(tmp_path / "log")
    assert code == 0, text
