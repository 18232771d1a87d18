"""One client without care, in a process of its own, and the others, who must not feel it: told by counts, not times."""

import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zenoh
from feeder import Feed as Drive
from feeding import Robot
from net import WAIT_S, Gathered, peer_config, wait_until
from processes import T0, Feed, Service, connected, events_in, replay

from roughmap_client.session import ask
from roughmap_schemas import CloudReason, IntegrationEvent, TileInfo, encode_cloud

SCANS = 40
ASKED = 15
"""Scans, and answers of a planner, while another client asks for everything: each waits for what is being answered."""

DROPPED = 600
"""Scans of the flooding robot that are dropped before it ends: seconds of it."""

STUCK, ENOUGH = 20, 600
"""So many scans in a row without an update, which come at 20 Hz otherwise; by the last one the link has been let go."""

TILES = 12
"""A side of the square that each scan of the quiet robot touches, in tiles: 144 tiles, so that an update is large."""


@contextmanager
def rude(what: str, service: Service) -> Iterator[subprocess.Popen[str]]:
    """A `rude.py` at work."""
    command = [sys.executable, str(Path(__file__).with_name("rude.py")), what, service.ready()["endpoints"][0]]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


def wide(number: int) -> bytes:
    """A scan that touches each tile of a square at ten places."""
    side = (np.arange(TILES * 4) + 0.5) * 1.6
    x, y = np.meshgrid(side, side)
    points = np.column_stack([x.ravel(), y.ravel(), 0.01 * number + np.sin(x.ravel())])
    return encode_cloud(points, T0 + number * 10**8, "map")


def hand_in(feed: Feed, number: int) -> None:
    """One scan of the quiet robot, until it is in the map."""
    receipt = feed.ingest("points", "quiet", wide(number))
    assert feed.decided(receipt.input).outcome == "integrated"


def outcomes(log: Path, robot: str) -> Counter[str]:
    """What became of a robot's clouds."""
    return Counter(str(e.outcome) for e in events_in(log) if isinstance(e, IntegrationEvent) and e.robot == robot)


def test_a_subscriber_that_stops_reading(tmp_path: Path) -> None:
    """Scans go on, a planner is answered, and another subscriber gets the last change of each tile."""
    with Service(tmp_path, updates={"update_hz": 20.0}) as service, connected(service) as feed:
        seen: Gathered[str] = Gathered()
        with zenoh.open(peer_config(connect=service.ready()["endpoints"])) as other:
            other.declare_subscriber("maps/site/updates/**", lambda sample: seen(str(sample.key_expr)))
            with rude("listen", service) as stopped:
                stopped.send_signal(signal.SIGSTOP)
                for number in range(SCANS):
                    hand_in(feed, number)
                    feed.client.region((0.0, 0.0, 6.0, 6.0))
                tiles = {tile.key for tile in feed.client.tiles()}
                assert len(tiles) == TILES**2
                before = len(seen.items)
                hand_in(feed, SCANS)
                keys = {f"maps/site/updates/0/{x}/{y}" for _, x, y in tiles}
                seen.wait(lambda came: keys <= set(came[before:]), "the last change of each tile")
                status = feed.settle()
                assert status.clouds.accepted == SCANS + 1
                assert status.health == "ok"
                assert not status.refused.get("busy")
        assert service.stop() == 0, service.err


def test_the_map_goes_on_while_a_subscriber_is_stuck(tmp_path: Path) -> None:
    """Until its link is let go, tile updates wait for it; scans, receipts and events don't."""
    with Service(tmp_path, updates={"update_hz": 20.0}) as service, connected(service) as feed:
        updates: Gathered[None] = Gathered()
        with zenoh.open(peer_config(connect=service.ready()["endpoints"])) as other, rude("listen", service) as stopped:
            other.declare_subscriber("maps/site/updates/**", lambda _: updates(None))
            hand_in(feed, 0)
            updates.wait(lambda came: len(came) >= TILES**2, "the first updates")
            stopped.send_signal(signal.SIGSTOP)
            seen, since = 0, 0
            for number in range(1, ENOUGH):
                hand_in(feed, number)
                since = since + 1 if len(updates.items) == seen else 0
                seen = len(updates.items)
                if since == STUCK:
                    break
        assert since == STUCK, "no scan came in while updates were stuck"
        assert service.stop() == 0, service.err


def test_a_client_that_asks_for_everything_in_a_loop(tmp_path: Path) -> None:
    """It is turned away where too many wait; a planner never is, nor a scan."""
    with Service(tmp_path) as service, connected(service) as feed:
        hand_in(feed, 0)
        with rude("ask", service) as greedy, zenoh.open(peer_config(connect=service.ready()["endpoints"])) as session:
            for number in range(1, ASKED):
                hand_in(feed, number)
                near = f"maps/site/region?bbox={number},0,{number + 5},5;layers=mean_height,slope"
                # Once, which the planner's client does not: it asks again where it was told `busy`.
                answer = ask(session, near, timeout=WAIT_S).single()
                assert TileInfo.model_validate_json(answer.attachment).map_sequence >= number
            asked, _ = greedy.communicate(timeout=WAIT_S)
        assert int(asked) > ASKED
        assert feed.settle().clouds.accepted == ASKED
        assert service.stop() == 0, service.err


def test_a_robot_that_floods_poses_and_scans(tmp_path: Path) -> None:
    """What is dropped is its own: of another robot, whose poses and scans are published, nothing is missing."""
    settings = {
        "map": {"cell_size": 0.05, "min_share": 0.0},
        "input": {"queue_limit": "2MiB", "max_message": "2MiB"},
        "sensors": {"lidar": {"range_sigma": 0.12}},
    }
    with Service(tmp_path, **settings) as service, connected(service) as feed:
        endpoints = service.ready()["endpoints"]
        flood = Drive(endpoints, "flood", 400.0, 4000, 2.0, y=100.0, stays=True, reach=5.0)
        quiet = Drive(endpoints, "quiet", 10.0, 500, 2.0, reach=3.0)
        with rude("poses", service) as poses, Robot(flood) as loud, Robot(quiet) as other:
            wait_until(
                lambda: feed.client.status().clouds.rejected.get(CloudReason.OVERLOAD, 0) >= DROPPED,
                "the flood to be dropped", 4 * WAIT_S,
            )  # fmt: skip
            sent = other.end()
            number, _ = poses.communicate(timeout=WAIT_S)
            loud.end()
        assert int(number) > 1000
        status = feed.client.status()
        assert service.stop() == 0, service.err
        assert sent["clouds"] > 5
        assert outcomes(service.log, "quiet") == {"integrated": sent["clouds"]}
        assert outcomes(service.log, "flood")["overload"] >= DROPPED
        assert not status.gaps.get("quiet")
        assert replay(service.log)[1].startswith("equal")
