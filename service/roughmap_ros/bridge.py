"""A ROS 2 node of roughmap: topics of robots in, one feed a robot; parts of the map out.

Which keys Zenoh uses is the node's affair (`wire`); where messages go is the sink's.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Final, Self

import zenoh

from roughmap_client import RoughMapClient
from roughmap_ros.feed import RobotFeed
from roughmap_ros.messages.types import LIVOX, ODOMETRY, POINT_CLOUD, POSE, POSE_STAMPED, TF, type_hash
from roughmap_ros.out.publishing import MapPublisher
from roughmap_ros.out.topics import map_topics
from roughmap_ros.wire import SENSOR_DATA, Qos, Received, RosNode
from roughmap_schemas import Config
from roughmap_schemas.faults import ReportedError
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.ros2_sections import Ros2Config

logger = logging.getLogger(__name__)

KINDS: Final[Mapping[str, Kind]] = {
    POINT_CLOUD: Kind.POINTS,
    LIVOX: Kind.POINTS,
    ODOMETRY: Kind.ODOMETRY,
    POSE: Kind.ODOMETRY,
    POSE_STAMPED: Kind.ODOMETRY,
    TF: Kind.TRANSFORM,
}
"""What a message of a ROS type counts as if it can't be used."""

STREAM: Final = Qos(reliable=False, depth=100)
"""Best effort, as SENSOR_DATA: it matches every publisher."""

STATIC: Final = Qos(reliable=True, transient_local=True, depth=100)

GONE_NS: Final = 60 * 10**9
"""A robot of which nothing came for so long is switched off, and that is no problem."""

REMEDY: Final = "; start what publishes it, or correct ros2.robots"
"""What to do about a topic or a link of the tf tree that is missing."""

ABSENT: Final = ("nothing came on ", " never came", " stopped ", " is not connected to ")
"""Words of sentences that say so."""

Sink = Callable[[str, RobotMessage], None]
"""Takes a message of a robot, in the order in which the robot's messages come."""

Refused = Callable[[str, Kind, str], None]
"""Takes robot, kind and fault of a ROS message that can't be used."""

Heard = Callable[[str, Kind, str, Received], None]
"""Takes robot, kind and topic of each ROS message, and the message, before it is read."""


@dataclass
class _Fed:
    """A robot, its feed, and the lock under which the feed is used."""

    robot: str
    feed: RobotFeed
    lock: threading.Lock = field(default_factory=threading.Lock)
    heard_ns: int | None = None
    """When its last message came; None before the first."""


def robot_feeds(config: Config, map_frame: str | None = None) -> dict[str, RobotFeed]:
    """Return a feed for each robot of ``[ros2]``; ``map_frame``: the map's frame, if not that of ``config``."""
    feeds = {}
    for name, topics in config.ros2.robots.items():
        mounted = {frame for frame, sensor in config.sensors_of(name).items() if sensor.extrinsics == "transform"}
        feeds[name] = RobotFeed(topics, map_frame or config.map.frame_id, mounted)
    return feeds


def ros_node(session: zenoh.Session, config: Config, name: str | None = None) -> RosNode:
    """Return the node of ``[ros2]``, a context manager, under another ``name`` if one is given."""
    ros2 = config.ros2
    return RosNode(session, name or ros2.node, keys=ros2.keys, domain=ros2.domain, max_message=config.input.max_message)


class Bridge:
    """Takes part in ROS 2 while it is entered.

    ``sink``, ``refused`` and ``heard`` are called in Zenoh's threads, for one robot by one thread at a time, and must
    not wait; ``client`` is asked for the map in a thread of the bridge. Without one, nothing is published.
    """

    def __init__(
        self,
        node: RosNode,
        config: Ros2Config,
        feeds: Mapping[str, RobotFeed],
        sink: Sink,
        refused: Refused,
        client: RoughMapClient | None = None,
        *,
        heard: Heard | None = None,
    ) -> None:
        self._node = node
        self._config = config
        self._fed = {robot: _Fed(robot, feed) for robot, feed in feeds.items()}
        self._sink = sink
        self._refused = refused
        self._client = client
        self._heard = heard
        self._publisher: MapPublisher | None = None
        self._counted: dict[tuple[str, str], int] = {}

    def __enter__(self) -> Self:
        if self._client is not None and self._config.out:
            topics = map_topics(self._node, self._config)
            self._publisher = MapPublisher(topics, self._client, self._position)
            self._publisher.start()
        for (topic, ros_type), fed in self._wanted().items():
            take = partial(self._take, topic, KINDS[ros_type], fed)
            self._node.subscriber(topic, ros_type, type_hash(ros_type), self._qos(topic, ros_type), take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._publisher is not None:
            self._publisher.close()

    def problems(self) -> dict[str, str]:
        """Return what is wrong at present, a sentence for each subject, which it begins with.

        Call it every few seconds, not from callbacks: it waits for Zenoh. It also tells ``refused`` of messages that
        the node refused.
        """
        self._tell_refused()
        found: dict[str, str] = {}
        for robot, sentences in self.of_robots().items():
            absent = any(word in sentence for sentence in sentences for word in ABSENT)
            found[f"robot {robot} ros2"] = f"robot {robot} ros2: {'; '.join(sentences)}{REMEDY if absent else ''}"
        for line in self._node.mismatches():
            subject = f"ros2 {line.partition(':')[0]}"
            found[subject] = f"{found[subject]}; {line}" if subject in found else f"ros2 {line}"
        if self._publisher is not None:
            for name, text in self._publisher.problems().items():
                found[f"ros2.out.{name}"] = f"ros2.out.{name}: can't be published: {text}"
        return found

    def of_robots(self) -> dict[str, list[str]]:
        """Return what is wrong at present with the topics and transforms of each robot that is on, in sentences."""
        found, now = {}, time.time_ns()
        for robot, fed in self._fed.items():
            with fed.lock:
                gone = fed.heard_ns is not None and now - fed.heard_ns > GONE_NS
                sentences = [] if gone else fed.feed.problems(now)
            if sentences:
                found[robot] = sentences
        return found

    def _tell_refused(self) -> None:
        """Tell of the messages that the node has refused since the last call."""
        readers: dict[str, tuple[Kind, list[_Fed]]] = {
            topic: (KINDS[ros_type], fed) for (topic, ros_type), fed in self._wanted().items()
        }
        for (topic, reason), number in self._node.refused.items():
            before = self._counted.get((topic, reason), 0)
            self._counted[topic, reason] = number
            kind, fed = readers.get(topic, (Kind.POINTS, []))
            for one in fed:
                for _ in range(number - before):
                    self._refused(one.robot, kind, f"{topic}: {reason}")

    def _wanted(self) -> dict[tuple[str, str], list[_Fed]]:
        """Return which robots read each topic and type: all robots may share /tf."""
        found: dict[tuple[str, str], list[_Fed]] = {}
        for fed in self._fed.values():
            for topic, ros_type in fed.feed.wanted().items():
                found.setdefault((topic, ros_type), []).append(fed)
        return found

    def _qos(self, topic: str, ros_type: str) -> Qos:
        if KINDS[ros_type] is not Kind.TRANSFORM:
            return SENSOR_DATA
        return STATIC if any(topic == robot.tf_static for robot in self._config.robots.values()) else STREAM

    def _position(self, robot: str) -> tuple[float, float] | None:
        return self._fed[robot].feed.position

    def _take(self, topic: str, kind: Kind, fed: list[_Fed], received: Received) -> None:
        """Give a message to the feeds of the robots that read its topic. Never raises: Zenoh's threads call it."""
        for one in fed:
            try:
                with one.lock:
                    one.heard_ns = received.received_ns
                    if self._heard is not None:
                        self._heard(one.robot, kind, topic, received)
                    for message in one.feed.take(topic, received.payload, received.received_ns):
                        self._sink(one.robot, message)
            except ReportedError as fault:
                self._refused(one.robot, kind, f"{topic}: {fault}")
            except Exception as error:
                logger.exception("a message of %s can't be used", topic)
                self._refused(one.robot, kind, f"{topic}: {type(error).__name__}")
