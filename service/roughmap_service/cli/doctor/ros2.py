"""Judges the topics of ``[ros2]``: who publishes them, whether types and QoS fit, what is missing in the tf tree."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zenoh

from roughmap_ros.bridge import ABSENT, Bridge, robot_feeds, ros_node
from roughmap_ros.key_sink import ENCODINGS
from roughmap_ros.wire import Received
from roughmap_schemas import Config
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_service.cli.doctor.findings import Finding, Verdict
from roughmap_service.cli.doctor.traffic import Message
from roughmap_service.inputs.ros2_checks import standing

AREA = "ros2"

MAX_KEPT = 20_000
"""Arrivals kept of one topic."""

MAX_FAULTS = 32
"""Faults of messages that are told."""


class Ros2Ears:
    """Listens to the robots' topics as the service does; a context manager.

    ``take`` gets the robots' messages as they would go into the service.

    Attributes:
        told: the subjects of problems on which there are findings, named as in the service's status.
    """

    def __init__(self, session: zenoh.Session, config: Config, take: Callable[[Message], None]) -> None:
        self._session = session
        self._config = config
        self._take = take
        self._lock = threading.Lock()
        self._heard: dict[str, deque[float]] = {}
        self._first: dict[str, str] = {}
        self._numbers: dict[str, tuple[int | None, str]] = {}
        self._faults: Counter[str] = Counter()
        self.told: set[str] = set()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        ros2 = self._config.ros2
        inputs = ros2.model_copy(update={"out": {}})
        self._feeds = robot_feeds(self._config)
        with ExitStack() as stack:
            self._node = stack.enter_context(ros_node(self._session, self._config, f"{ros2.node}_doctor"))
            bridge = Bridge(self._node, inputs, self._feeds, self._put, self._refuse, heard=self._hear)
            self._bridge = stack.enter_context(bridge)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def judge(self) -> list[Finding]:
        """Return what was found; call it before the end."""
        config, lines = self._config, self._node.mismatches()
        self.told = set(self._bridge.problems())
        findings = [Finding(AREA, "wrong", line, FITTING) for line in lines]
        if config.ros2.keys == "rmw_zenoh" and config.ros2.robots and not self._node.seen():
            text = f"no ROS node is seen in domain {config.ros2.domain}"
            findings.append(Finding(AREA, "wrong", text, NO_NODE))
        else:
            unpublished = self._node.unpublished()
            findings += [Finding(AREA, self._absent(line.partition(":")[0]), line, PUBLISHING) for line in unpublished]
            findings += self._topics({line.partition(":")[0] for line in (*lines, *unpublished)})
        findings += [
            Finding(
                AREA, "wrong", f"robot {robot}: {sentence}", TREE if any(map(sentence.__contains__, ABSENT)) else ""
            )
            for robot, sentences in self._bridge.of_robots().items()
            for sentence in sentences
            if not (sentence.endswith(" never came") or sentence.startswith("nothing came on "))  # told of each topic
        ]
        with self._lock:
            faults = self._faults.most_common(MAX_FAULTS)
        for text, number in faults:
            what = "1 message" if number == 1 else f"{number} messages"
            findings.append(Finding(AREA, "wrong", f"{what} can't be used: {text}"))
        router = standing(config)
        return findings if router is None else [*findings, Finding(AREA, "wrong", router)]

    def _topics(self, judged: set[str]) -> list[Finding]:
        """Tell how often each topic came, and which didn't come though nothing else is known to be wrong with it."""
        findings = []
        for topic in sorted({topic for feed in self._feeds.values() for topic in feed.wanted()}):
            with self._lock:
                at = list(self._heard.get(topic, ()))
            if len(at) > 1:
                rate = (len(at) - 1) / max(at[-1] - at[0], 1e-9)
                findings.append(Finding(AREA, "ok", f"{topic} at {rate:.1f} Hz"))
            elif at:
                findings.append(Finding(AREA, "ok", f"{topic} came once"))
            elif topic not in judged:
                bridged = self._config.ros2.keys == "ros2dds"
                text = f"nothing came on {topic}" + ("" if bridged else ", though a node publishes it")
                findings.append(Finding(AREA, self._absent(topic), text, BRIDGED if bridged else SENDING))
        return findings

    def _absent(self, topic: str) -> Verdict:
        """Judge that nothing came on a topic: of transforms, those that are needed are told by themselves."""
        types = {feed.wanted().get(topic) for feed in self._feeds.values()}
        return "note" if types <= {None, "tf2_msgs/msg/TFMessage"} else "wrong"

    def _hear(self, robot: str, _kind: Kind, topic: str, received: Received) -> None:
        with self._lock:
            if robot == self._first.setdefault(topic, robot):  # others read the same message
                self._heard.setdefault(topic, deque(maxlen=MAX_KEPT)).append(time.monotonic())
            source = "" if received.gid is None else received.gid.hex()
            self._numbers[robot] = received.sequence, f"{topic} {source}"

    def _put(self, robot: str, message: RobotMessage) -> None:
        with self._lock:
            number, source = self._numbers.get(robot, (None, ""))
        self._take(Message(message.kind, robot, message.payload, ENCODINGS[message.kind], 0, number, source))

    def _refuse(self, robot: str, _kind: Kind, text: str) -> None:
        with self._lock:
            self._faults[f"robot {robot}: {text}"] += 1


FITTING = "build both sides from the same version of the message, and let the publisher offer what is asked for"
NO_NODE = (
    "start the ROS nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp, use their ROS_DOMAIN_ID as ros2.domain, and let both "
    "sides connect to one router (zenoh.connect)"
)
PUBLISHING = "start its driver, or correct the topic in ros2.robots"
SENDING = "look whether its node is alive: `ros2 topic hz`"
BRIDGED = (
    "start roughmap's node or zenoh-bridge-ros2dds beside the robot, and let it pass this topic; the node's log says "
    "whether nobody publishes it, or which other type it has"
)
TREE = "start what publishes this transform, or correct the frames in ros2.robots"
"""What to do."""
