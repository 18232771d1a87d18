"""A rover on ROS topics drives into the service: the map is the same as by the messages of the contract."""

from pathlib import Path

import pytest
from net import wait_until
from processes import Feed, events_in, inputs_in, running
from ros_rover import LEVEL, ROBOT, SCANNER, START_NS, TF_STATIC, RosRover, messages, ros_session, settings, transforms

from roughmap_schemas import CheckpointEvent, MapStatus
from roughmap_service.simulation.rover import MOUNT

SECONDS = 1.5


def digest_of(log: Path) -> str:
    """Return the map's last digest in a log."""
    return [event for event in events_in(log) if isinstance(event, CheckpointEvent)][-1].digest


def all_decided(feed: Feed) -> MapStatus:
    """Wait until all clouds are in the map."""
    clouds = round(SECONDS * SCANNER.rate_hz)

    def decided() -> MapStatus | None:
        status = feed.client.status()
        return status if status.clouds.accepted >= clouds else None

    return wait_until(decided, f"{clouds} clouds in the map")


@pytest.fixture(scope="module")
def plain_digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of the map that the same messages make when they come as those of the contract."""
    directory, plain = tmp_path_factory.mktemp("plain"), settings()
    del plain["ros2"]
    with running(directory, **plain) as (_, feed):
        for message in messages(SECONDS):
            feed.ingest(message.kind, "rover1", message.payload)
        all_decided(feed)
    return digest_of(directory / "log")


@pytest.mark.parametrize("keys", ["rmw_zenoh", "ros2dds"])
def test_a_drive_on_ros_topics_gives_the_map_of_the_same_messages(keys: str, tmp_path: Path, plain_digest: str) -> None:
    with (
        running(tmp_path, **settings(keys=keys)) as (service, feed),
        ros_session(service.ready()["endpoints"]) as session,
    ):
        rover = RosRover(session, keys)
        rover.wait_for_listeners()
        rover.drive(messages(SECONDS))
        status = all_decided(feed)
        assert (status.refused, status.gaps) == ({}, {})
    # The log was replayed as equal when the service stopped.
    assert digest_of(tmp_path / "log") == plain_digest
    # ROS leaves no trace: the log holds messages of the contract.
    topics = {message.topic for message in inputs_in(tmp_path / "log")}
    assert {"robots/rover1/points", "robots/rover1/odometry"} <= topics


def test_poses_and_the_mounting_may_come_from_tf(tmp_path: Path, plain_digest: str) -> None:
    given = settings(robots={"rover1": ROBOT | {"poses": "tf"}})
    lidar = {
        name: value for name, value in given["sensors"]["lidar"].items() if name not in ("translation", "rotation")
    }
    given["sensors"] = {"lidar": lidar | {"extrinsics": "transform"}}
    with running(tmp_path, **given) as (service, feed), ros_session(service.ready()["endpoints"]) as session:
        rover = RosRover(session)
        rover.wait_for_listeners()
        rover.publishers[TF_STATIC].put(
            transforms((START_NS, "map", "odom", (0, 0, 0), LEVEL), (START_NS, "base", "lidar", MOUNT, LEVEL))
        )
        rover.drive(messages(SECONDS))
        all_decided(feed)
    assert digest_of(tmp_path / "log") == plain_digest
