"""A rover on ROS topics drives into the service: the map is the same as by the messages of the contract."""

from pathlib import Path

from net import wait_until
from processes import Feed, events_in, inputs_in, running
from ros_rover import RosRover, messages, ros_session, settings

from roughmap_schemas import CheckpointEvent, MapStatus

SECONDS = 1.5


def digest_of(log: Path) -> str:
    """Return the map's last digest in a log."""
    return [event for event in events_in(log) if isinstance(event, CheckpointEvent)][-1].digest


def all_decided(feed: Feed, clouds: int) -> MapStatus:
    def decided() -> MapStatus | None:
        status = feed.client.status()
        return status if status.clouds.accepted + sum(status.clouds.rejected.values()) >= clouds else None

    return wait_until(decided, f"{clouds} decided clouds")


def test_a_drive_on_ros_topics_gives_the_map_of_the_same_messages(tmp_path: Path) -> None:
    sent = messages(SECONDS)
    clouds = sum(message.kind == "points" for message in sent)
    plain = settings()
    del plain["ros2"]
    with running(tmp_path / "plain", **plain) as (_, feed):
        for message in sent:
            feed.ingest(message.kind, "rover1", message.payload)
        assert all_decided(feed, clouds).clouds.accepted == clouds
    with running(tmp_path / "ros", **settings()) as (service, feed), ros_session(service.ready()["endpoints"]) as ros:
        rover = RosRover(ros)
        rover.wait_for_listeners()
        rover.drive(sent)
        status = all_decided(feed, clouds)
        assert (status.clouds.accepted, status.refused, status.gaps) == (clouds, {}, {})
    # Both logs were replayed as equal when their services stopped.
    assert digest_of(tmp_path / "ros" / "log") == digest_of(tmp_path / "plain" / "log")
    # ROS leaves no trace: the log holds messages of the contract.
    topics = {message.topic for message in inputs_in(tmp_path / "ros" / "log")}
    assert topics >= {"robots/rover1/points", "robots/rover1/odometry"}
