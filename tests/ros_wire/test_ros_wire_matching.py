"""What doctor says of endpoints that don't fit, of messages refused, and of a session in the router's place."""

from dataclasses import replace

import pytest

from roughmap_ros.wire import SENSOR_DATA, Entity, Kind, Qos, router_problem
from roughmap_ros.wire.matching import hash_text, mismatch, mismatches, unpublished
from roughmap_ros.wire.qos import qos_text
from roughmap_ros.wire.refusals import MAX_REASONS, Refusals

CLOUD = "sensor_msgs/msg/PointCloud2"
OURS = Entity(Kind.SUBSCRIBER, 0, "aa", 0, 1, "/", "roughmap", "/points", CLOUD, "RIHS01_11", qos_text(Qos()))
THEIRS = Entity(Kind.PUBLISHER, 0, "bb", 0, 1, "/robot", "lidar", "/points", CLOUD, "RIHS01_11", qos_text(Qos()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None),
        ({"topic": "/other"}, None),
        ({"kind": Kind.SUBSCRIBER, "type_hash": "RIHS01_22"}, None),
        (
            {"qos_text": qos_text(SENSOR_DATA)},
            "/points: a publisher (/robot/lidar) offers best_effort volatile; we ask for reliable",
        ),
        (
            {"ros_type": "sensor_msgs/msg/LaserScan"},
            f"/points: a publisher (/robot/lidar) has another type: sensor_msgs/msg/LaserScan; expected {CLOUD}",
        ),
        (
            {"type_hash": "RIHS01_22"},
            f"/points: a publisher (/robot/lidar): {hash_text(CLOUD, 'RIHS01_22', 'RIHS01_11')}",
        ),
    ],
)
def test_a_publisher_that_does_not_fit_is_told_in_words(change: dict[str, object], words: str | None) -> None:
    assert mismatch(OURS, replace(THEIRS, **change)) == words  # type: ignore[arg-type]


def test_another_hash_is_another_version_of_the_message() -> None:
    assert hash_text("a/msg/B", "RIHS01_22", "RIHS01_11") == (
        "hash RIHS01_22 differs: another version of a/msg/B; expected RIHS01_11"
    )


def test_humble_is_refused_by_name() -> None:
    line = mismatch(OURS, replace(THEIRS, type_hash="TypeHashNotSupported"))
    assert line is not None
    assert "TypeHashNotSupported: rmw_zenoh of ROS 2 Humble" in line
    assert "zenoh-bridge-ros2dds" in line


def test_a_subscriber_for_sensor_data_takes_what_any_publisher_offers() -> None:
    ours = replace(OURS, qos_text=qos_text(SENSOR_DATA))
    for qos in (Qos(), SENSOR_DATA, Qos(transient_local=True)):
        assert mismatch(ours, replace(THEIRS, qos_text=qos_text(qos))) is None


def test_a_subscriber_that_asks_for_more_than_we_offer_is_told() -> None:
    ours = replace(OURS, kind=Kind.PUBLISHER)
    theirs = replace(THEIRS, kind=Kind.SUBSCRIBER, qos_text=qos_text(Qos(transient_local=True)))
    assert mismatch(ours, theirs) == (
        "/points: a subscriber (/robot/lidar) asks for transient_local; we offer reliable volatile"
    )


def test_a_client_of_another_service_type_is_told() -> None:
    ours = replace(OURS, kind=Kind.SERVICE, topic="/get_map", ros_type="nav_msgs/srv/GetMap")
    theirs = replace(THEIRS, kind=Kind.CLIENT, topic="/get_map", ros_type="nav_msgs/srv/GetPlan")
    assert mismatch(ours, theirs) == (
        "/get_map: a client (/robot/lidar) has another type: nav_msgs/srv/GetPlan; expected nav_msgs/srv/GetMap"
    )


def test_a_topic_that_nobody_publishes_is_told_with_topics_of_its_type() -> None:
    others = [replace(THEIRS, topic="/lidar/points"), replace(THEIRS, topic="/scan", ros_type="a/msg/B")]
    assert unpublished([OURS], others) == [
        "/points: no node publishes it; sensor_msgs/msg/PointCloud2 is on /lidar/points"
    ]
    assert unpublished([OURS], []) == ["/points: no node publishes it"]


def test_what_does_not_fit_is_sorted_and_told_once() -> None:
    best_effort = replace(THEIRS, qos_text=qos_text(SENSOR_DATA))
    theirs = [best_effort, replace(best_effort, id=5), replace(best_effort, topic="/a")]
    lines = mismatches([OURS, replace(OURS, topic="/a")], theirs)
    assert [line.split(":")[0] for line in lines] == ["/a", "/points"]


def test_refusals_are_counted_by_reason_and_bounded() -> None:
    refusals = Refusals()
    refusals.count("/points", "too large")
    for number in range(2 * MAX_REASONS):
        refusals.count("/points", f"reason {number}")
    refusals.count("/points", "too large")
    assert refusals.counts["/points", "too large"] == 2
    assert refusals.counts["/points", "other reasons"] == MAX_REASONS + 1
    assert sum(refusals.counts.values()) == 2 * MAX_REASONS + 2
    assert refusals.counts["/points", "reason 0"] == 1


@pytest.mark.parametrize(
    ("mode", "listen", "keys", "told"),
    [
        ("peer", ["tcp/127.0.0.1:7447"], "rmw_zenoh", True),
        ("peer", ["udp/127.0.0.1:1", "tcp/[::]:7447#iface=eth0"], "rmw_zenoh", True),
        ("router", ["tcp/[::]:7447"], "rmw_zenoh", False),
        ("client", [], "rmw_zenoh", False),
        ("peer", ["tcp/127.0.0.1:17447", "tls/127.0.0.1:7447"], "rmw_zenoh", False),
        ("peer", ["tcp/127.0.0.1:7447"], "ros2dds", False),
    ],
)
def test_a_peer_in_the_place_of_the_router_is_told(mode: str, listen: list[str], keys: str, told: bool) -> None:
    problem = router_problem(mode, listen, keys, scouting=True)  # type: ignore[arg-type]
    assert (problem is not None) is told
    if problem is not None:
        assert 'zenoh.mode = "router"' in problem
        assert "rmw_zenohd" in problem


def test_a_peer_that_hears_no_gossip_is_told() -> None:
    problem = router_problem("peer", ["tcp/127.0.0.1:17447"], "rmw_zenoh")
    assert problem is not None
    assert problem.startswith('zenoh.mode is "peer" without scouting, which hears no ROS nodes')
    assert router_problem("client", [], "rmw_zenoh") is None
