"""A robot in a process of its own until its standard input closes: `feeder.py JSON`; what it sent comes last, as JSON.

It drives over waves that have no end and publishes poses at `POSES_HZ`, which wait for the network, and scans, which
are dropped where the network doesn't take them, as a live robot's are. Both are numbered, so that the service counts
what it never got: by Zenoh's own numbers, because those in attachments may pass for another count's where counts cross.
The first scan and the last wait as well: a gap is seen only between two.
"""

import heapq
import itertools
import json
import math
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
import soak_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import peer_config
from processes import LEVEL, PRECISE, T0

from roughmap_schemas import encode_cloud, encode_odometry

S = 10**9
POSES_HZ = 50
TURN_M = 40.0
"""The radius of the circle that a robot drives which stays."""

SENSOR_M = 1.0
"""The sensor over the ground under the robot."""


@dataclass
class Feed:
    """What a robot does. ``speed`` in m/s; it goes along x at ``y`` for ever, or round a circle (``stays``).
    ``second`` is where on its way, and in its stamps, it begins."""

    endpoints: list[str]
    robot: str
    clouds_hz: float
    points: int
    speed: float
    y: float = 0.0
    stays: bool = False
    second: float = 0.0
    reach: float = 10.0

    def position(self, seconds: float) -> tuple[float, float, float]:
        """Of its base in the map, in metres."""
        x, y = self.speed * seconds, self.y
        if self.stays:
            x, y = TURN_M * math.cos(x / TURN_M), self.y + TURN_M * math.sin(x / TURN_M)
        return x, y, float(ground(np.array(x), np.array(y)))


def ground(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Heights of waves that have no end."""
    height: npt.NDArray[np.float64] = np.sin(0.21 * x) + 0.4 * np.sin(0.9 * y + 0.3 * x)
    return height


def spread(feed: Feed) -> npt.NDArray[np.float64]:
    """(points, 2) around the robot, denser near it, in the order of a scanner that turns."""
    turns = np.linspace(0.0, 2 * np.pi, feed.points, endpoint=False)
    radius = 0.8 + (feed.reach - 0.8) * (np.arange(feed.points) % 64 / 64.0) ** 1.5
    return np.column_stack([radius * np.cos(turns), radius * np.sin(turns)])


def run(feed: Feed) -> dict[str, int]:
    """Publish until nobody holds standard input open; how many clouds and poses were sent."""
    told = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), told.set()), daemon=True).start()
    offsets = spread(feed)
    block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    sent = {"points": 0, "odometry": 0}

    def put(kind: str, payload: bytes, control: zenoh.CongestionControl) -> None:
        priority = zenoh.Priority.DATA_HIGH if kind == "odometry" else zenoh.Priority.DATA
        session.put(
            f"robots/{feed.robot}/{kind}", payload, congestion_control=control, priority=priority,
            source_info=zenoh.SourceInfo(publisher.id, sent[kind]),
        )  # fmt: skip
        sent[kind] += 1

    def pose(seconds: float) -> None:
        stamp = T0 + round(seconds * S)
        put("odometry", encode_odometry(stamp, "map", feed.position(seconds), LEVEL, PRECISE), block)

    def scan(seconds: float, control: zenoh.CongestionControl) -> None:
        x, y, z = feed.position(seconds)
        heights = ground(x + offsets[:, 0], y + offsets[:, 1]) - (z + SENSOR_M)
        points = np.column_stack([offsets, heights]).astype(np.float32)
        put("points", encode_cloud(points, T0 + round(seconds * S), "lidar"), control)

    with zenoh.open(peer_config(connect=feed.endpoints)) as session:
        publisher = session.declare_publisher(f"robots/{feed.robot}/points")
        heard = threading.Event()
        publisher.declare_matching_listener(lambda status: heard.set() if status.matching else None)
        if not getattr(publisher.matching_status, "matching", publisher.matching_status) and not heard.wait(30.0):
            raise SystemExit("nobody listens")
        begun, last = time.monotonic(), feed.second
        pose(feed.second)
        scan(feed.second, block)
        dues = _dues(feed)
        for last, kind in dues:
            left = begun + last - feed.second - time.monotonic()
            if told.wait(max(left, 0.0)):
                break
            if kind == "pose":
                pose(last)
            else:
                scan(last, drop)
        scan(last, block)
        pose(last + 1.0 / POSES_HZ)
        publisher.undeclare()
    return {"clouds": sent["points"], "poses": sent["odometry"], "second": math.ceil(last + 1)}


def _dues(feed: Feed) -> Iterator[tuple[float, str]]:
    poses = ((feed.second + k / POSES_HZ, "pose") for k in itertools.count(1))
    scans = ((feed.second + (k - 0.5) / feed.clouds_hz, "scan") for k in itertools.count(1))
    return heapq.merge(poses, scans)


def command(feed: Feed) -> list[str]:
    """How to start it."""
    return [sys.executable, __file__, json.dumps(asdict(feed))]


if __name__ == "__main__":
    print(json.dumps(run(Feed(**json.loads(sys.argv[1])))))
