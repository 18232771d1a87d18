"""`roughmap ros2`, a process beside a service without [ros2]: the same messages in, the same map out."""

import json
import logging
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from net import WAIT_S, Gathered, peer_config, wait_until
from processes import COMMAND, END_S, Feed, configuration, environment, running
from ros_rover import LATCHED, ROS, RosRover, messages, ros_session, settings
from test_ros_drive import digest_of

from roughmap_ros.wire import RosNode
from roughmap_service.cli.main import run
from roughmap_service.simulation.rover import Message

BOX = (-6.0, -6.0, 6.0, 5.0)
GRID = "nav_msgs/msg/OccupancyGrid"
OUT = {"costmap": {"type": "OccupancyGrid", "box": BOX, "rate": 20.0}}


def router_locators(session: zenoh.Session) -> list[str]:
    """Return the endpoints of a session that is a router."""
    for reply in session.get(f"@/{session.zid()}/router", timeout=WAIT_S):
        if reply.ok is not None:
            return [str(locator) for locator in json.loads(reply.ok.payload.to_bytes())["locators"]]
    raise AssertionError("the router's admin space did not answer")


@contextmanager
def bridge(directory: Path, given: dict[str, Any], *arguments: str) -> Iterator[None]:
    """Run `roughmap ros2`; it must end with 0 on SIGINT."""
    config = configuration(directory, given)
    errors = (directory / "errors.txt").open("w")
    process = subprocess.Popen(
        [*COMMAND, "ros2", "-c", str(config), *arguments],
        stdout=subprocess.PIPE, stderr=errors, text=True, env=environment(),
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline() or "{}").get("ready"), (directory / "errors.txt").read_text()
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(END_S) == 0, (directory / "errors.txt").read_text()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        errors.close()


def grid_of(endpoints: list[str], expected: np.ndarray) -> None:
    """Join late, and wait for a grid whose known cells are those expected."""
    came: Gathered[np.ndarray] = Gathered()

    def take(received: Any) -> None:
        message = ROS.deserialize_cdr(received.payload, GRID)
        came(np.asarray(message.data).reshape(message.info.height, message.info.width))

    with ros_session(endpoints) as session, RosNode(session, "late", keys="rmw_zenoh") as node:
        node.subscriber("/roughmap/costmap", GRID, ROS.hash_rihs01(GRID), LATCHED, take)
        came.wait(lambda items: ((items[-1] >= 0) == expected).all() if items else False, "the grid")


def drive(endpoints: list[str], feed: Feed, sent: list[Message]) -> None:
    """Drive, until all is in the map and in the grid that comes out."""
    clouds = sum(message.kind == "points" for message in sent)
    with ros_session(endpoints) as ros:
        rover = RosRover(ros)
        rover.wait_for_listeners()
        rover.drive(sent)
        wait_until(lambda: feed.client.status().clouds.accepted >= clouds, "all clouds")
        assert feed.client.status().gaps == {}
    x, y, u, v = BOX
    region = feed.client.region((x + 0.01, y + 0.01, u - 0.01, v - 0.01), ["traversability"])
    grid_of(endpoints, ~np.isnan(region["traversability"]))


def test_the_bridge_as_a_process_gives_the_same_map_and_the_same_topics(tmp_path: Path) -> None:
    sent = messages(1.0)
    given = settings(out=OUT)
    plain = {name: value for name, value in given.items() if name != "ros2"}
    with running(tmp_path / "inside", **given) as (service, feed):
        drive(service.ready()["endpoints"], feed, sent)
    router = peer_config(listen=True, mode="router")
    with running(tmp_path / "beside", **plain) as (service, feed), zenoh.open(router) as session:
        ros, where = router_locators(session), service.ready()["endpoints"]
        with bridge(tmp_path / "bridge", given, "--connect", where[0], "--ros", ros[0]):
            drive(ros, feed, sent)
    assert digest_of(tmp_path / "beside" / "log") == digest_of(tmp_path / "inside" / "log")


def test_without_topics_it_says_what_to_configure(capsys: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["ros2"]) == 2
    assert "[ros2.robots.NAME] or [ros2.out.NAME]" in capsys.readouterr().err


def test_a_topic_that_can_never_be_published_is_told_at_once(capsys: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    before = logging.getLogger().handlers[:], signal.getsignal(signal.SIGINT)
    for out, word in (
        ({"box": [0, 0, 1000, 1000]}, "query.max_region_cells"),
        ({"level": 40}, "map.levels"),
        ({"layers": ["std_dev", "obstacle"]}, "obstacle"),
    ):
        given = {"m": {"type": "GridMap", "box": [0, 0, 1, 1], **out}}
        arguments = ["--set", f"ros2.out={json.dumps(given)}", "--set", "map.surface=all"]
        assert run(["ros2", *arguments]) == 2
        assert word in capsys.readouterr().err
    assert run(["ros2", "--set", 'ros2.out={"3d": {"type": "GridMap", "box": [0, 0, 1, 1], "topic": "/3d"}}']) == 2
    assert "/3d" in capsys.readouterr().err
    assert (logging.getLogger().handlers, signal.getsignal(signal.SIGINT)) == before
