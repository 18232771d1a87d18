"""[ros2] that can't mean anything is refused by name."""

from typing import Any

import pytest

from roughmap_schemas import ConfigFault, config_from
from roughmap_service.inputs.ros2_checks import check_topics

ROBOT = {"clouds": ["/points"], "odometry": "/odom"}
GRID, OCCUPANCY = {"type": "GridMap"}, {"type": "OccupancyGrid"}


def check(robots: dict[str, Any], out: dict[str, Any] | None = None) -> None:
    check_topics(config_from({"ros2": {"robots": robots, "out": out or {}}}, "here"))


@pytest.mark.parametrize(
    ("robots", "words"),
    [
        ({"a": {"clouds": ["/points"], "odometry": "/points"}}, "found a.clouds and a.odometry"),
        ({"a": {"clouds": ["/points"], "livox": ["/points"]}}, "found a.clouds and a.livox"),
        ({"a": {**ROBOT, "tf": "/tf_static"}}, "found a.tf and a.tf_static"),
        ({"a": ROBOT, "b": ROBOT}, "found a.clouds and b.clouds"),
        ({"a": ROBOT, "b": {"clouds": ["/odom"], "pose": "/pose"}}, "found a.odometry and b.clouds"),
    ],
)
def test_a_topic_has_one_meaning_for_one_robot(robots: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigFault, match=words):
        check(robots)


def test_robots_share_their_transforms() -> None:
    check({"a": ROBOT, "b": {"clouds": ["/b/points"], "odometry": "/b/odom"}})


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ({"a": {**GRID, "topic": "/x"}, "b": {**OCCUPANCY, "topic": "/x"}}, "/x is published by ros2.out.a already"),
        ({"a-b": GRID, "a_b": OCCUPANCY}, "/roughmap/a_b is published by ros2.out.a-b already"),
        ({"a": {**OCCUPANCY, "topic": "/x"}, "b": {**GRID, "topic": "/x_updates"}}, "/x_updates is published by"),
        ({"a": {"type": "PointCloud2", "topic": "/points"}}, "/points is read already"),
        ({"a": {**GRID, "topic": "/tf"}}, "/tf is read already"),
        ({"a": {**GRID, "box": [-1e308, -1e308, 1e308, 1e308]}}, "its window is no size of a map"),
        ({"a": {**GRID, "size": [1e308, 1]}}, "its window is no size of a map"),
        ({"a": {**GRID, "box": [-1e6, -1e6, 1e6, 1e6]}}, "query.max_region_cells"),
    ],
)
def test_a_topic_of_the_map_is_one_that_can_be_published(out: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigFault, match=words):
        check({"robot": ROBOT}, out)
