"""One robot's ROS messages in, messages of roughmap's contract out: the same live and from a recording."""

from collections.abc import Callable, Collection
from functools import partial
from typing import Final, NamedTuple

from roughmap_ros.heard import Heard
from roughmap_ros.messages import (
    PoseRead,
    cloud_message,
    livox_message,
    read_odometry,
    read_pose,
    read_pose_stamped,
    transforms_of,
)
from roughmap_ros.messages.cdr import read_header
from roughmap_ros.messages.types import LIVOX, ODOMETRY, POINT_CLOUD, POSE, POSE_STAMPED, TF
from roughmap_ros.tf.composed_poses import ComposedPoses, Stamped
from roughmap_ros.tf.covariances import Covariance, Covariances
from roughmap_ros.tf.given_poses import GivenPose, GivenPoses
from roughmap_ros.tf.missing import Words
from roughmap_ros.tf.mountings import Mountings
from roughmap_ros.tf.rigid import Rigid, is_finite
from roughmap_ros.tf.tree import Tree
from roughmap_schemas import encode_odometry, encode_transform
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.ros2_sections import Ros2RobotConfig

MAX_PROBLEMS: Final = 20
"""Problems that are told at once."""

Read = Callable[[bytes], PoseRead]
"""Reads a message with a pose."""

POSE_TYPES: Final[dict[str, tuple[str, Read]]] = {
    "odometry": (ODOMETRY, read_odometry),
    "pose": (POSE, read_pose),
    "pose_stamped": (POSE_STAMPED, read_pose_stamped),
}
"""By the setting that names their topic: the type, and what reads it."""


class _Topic(NamedTuple):
    ros_type: str
    take: Callable[[bytes, int], list[RobotMessage]]
    heard: Heard


class RobotFeed:
    """The messages of one robot, in the order in which they came. It has no transport, no thread and no clock.

    ``topics`` names what is read. Poses come out in ``map_frame``, or in the frame of their topic with the transforms
    of that frame to the map. ``mounted`` are the frames of sensors whose mounting comes from transforms: it goes out
    before their clouds, which wait for it.

    Attributes:
        position: the newest position in the map frame, x and y in metres; None before the first.
    """

    def __init__(self, topics: Ros2RobotConfig, map_frame: str, mounted: Collection[str]) -> None:
        self.position: tuple[float, float] | None = None
        self._map_frame = map_frame
        self._base = topics.base
        self._from_tf = topics.source == "tf"
        self._has_tf = bool(topics.tf or topics.tf_static)
        self._now_ns = 0
        self._tree = Tree()
        self._words = Words(self._tree, topics.tf, topics.tf_static)
        self._mountings = Mountings(self._tree, self._base, mounted)
        self._composed = ComposedPoses(self._tree, map_frame, self._base)
        self._covariances = Covariances(self._tree, map_frame, self._base)
        self._given = GivenPoses(self._tree, map_frame, self._base, has_tf=self._has_tf)
        self._pose_topic = ""
        self._topics = self._read_topics(topics)

    def wanted(self) -> dict[str, str]:
        """Return the ROS type of each topic that is read, as in "sensor_msgs/msg/PointCloud2"."""
        return {name: topic.ros_type for name, topic in self._topics.items()}

    def take(self, topic: str, cdr: bytes, log_ns: int) -> list[RobotMessage]:
        """Take a message that came at ``log_ns``; return what can be sent on now, in order.

        Of a topic that is not `wanted`, nothing. Raises ``BadRosMessage``; then nothing has changed but the count.
        """
        wanted = self._topics.get(topic)
        if wanted is None:
            return []
        wanted.heard.note(log_ns)
        self._now_ns = max(self._now_ns, log_ns)
        return wanted.take(cdr, log_ns)

    def end(self) -> list[RobotMessage]:
        """Return what is held back at a recording's end: it waits for what will not come."""
        messages = self._poses(self._now_ns, wait=False)
        return messages + self._mountings.rest(self._now_ns)

    def problems(self, now_ns: int) -> list[str]:
        """Say what is missing or wrong, one line each, at most 20. ``now_ns`` is of the clock of ``log_ns``."""
        if not any(topic.heard.count for topic in self._topics.values()):
            return [f"nothing came on {', '.join(self._topics)}"]
        lines = [problem for topic in self._topics.values() if (problem := topic.heard.problem(now_ns))]
        lines += self._pose_problems(now_ns)
        for sensor in self._mountings.sensors:
            lines += self._sensor_problems(sensor, now_ns)
        lines += self._words.tangled()
        lines = list(dict.fromkeys(lines))
        more = len(lines) - MAX_PROBLEMS + 1
        return lines if more < 2 else [*lines[: MAX_PROBLEMS - 1], f"and {more} more"]

    def _read_topics(self, topics: Ros2RobotConfig) -> dict[str, _Topic]:
        found: dict[str, _Topic] = {}

        def add(
            topic: str,
            ros_type: str,
            take: Callable[[bytes, int], list[RobotMessage]],
            *,
            steady: bool = True,
            needed: bool = True,
        ) -> None:
            found.setdefault(topic, _Topic(ros_type, take, Heard(topic, steady, needed)))

        for topic in topics.clouds:
            add(topic, POINT_CLOUD, partial(self._take_cloud, cloud_message))
        for topic in topics.livox:
            add(topic, LIVOX, partial(self._take_cloud, livox_message))
        setting: str = topics.source
        if self._from_tf:  # then the topic gives covariances
            setting = "odometry" if topics.odometry else "pose"
        topic = getattr(topics, setting)
        if topic:
            self._pose_topic = topic
            ros_type, read = POSE_TYPES[setting]
            add(topic, ros_type, partial(self._take_pose, read), steady=not self._from_tf)
        for name, static in ((topics.tf, False), (topics.tf_static, True)):
            if name:  # the links that are needed are judged, not the topic: many robots have no static transforms
                add(name, TF, partial(self._take_tf, static=static), steady=False, needed=False)
        return found

    def _take_tf(self, cdr: bytes, log_ns: int, *, static: bool) -> list[RobotMessage]:
        self._tree.take(transforms_of(cdr), static=static, log_ns=log_ns)
        return [*self._poses(log_ns), *self._mountings.changed(log_ns)]

    def _take_cloud(self, read: Callable[[bytes, int], RobotMessage], cdr: bytes, log_ns: int) -> list[RobotMessage]:
        cloud = read(cdr, log_ns)
        header = read_header(cdr)
        messages = []
        if self._from_tf:  # a robot that stands: links without stamps give poses where clouds need them
            fixed = self._composed.fixed()
            if fixed is not None:
                messages.append(self._composed_message(Stamped(header.stamp_ns, fixed), log_ns))
        if header.frame_id in self._mountings.sensors:
            return messages + self._mountings.take(header.frame_id, header.stamp_ns, cloud)
        return [*messages, cloud]

    def _take_pose(self, read: Read, cdr: bytes, log_ns: int) -> list[RobotMessage]:
        pose = read(cdr)
        body = pose.body_frame_id if read is read_odometry else self._base  # others don't name it
        if self._from_tf:
            self._covariances.take(pose.stamp_ns, pose.frame_id, body, pose.covariance)
            return []
        place = Rigid(pose.position, pose.rotation)
        ready = self._given.take(GivenPose(pose.stamp_ns, pose.frame_id, body, place, pose.covariance))
        return self._given_messages(ready, log_ns)

    def _poses(self, log_ns: int, *, wait: bool = True) -> list[RobotMessage]:
        """Return the poses, and the transforms of their frame, that can be given now."""
        if self._from_tf:
            return [self._composed_message(one, log_ns) for one in self._composed.new(wait=wait)]
        return self._given_messages(self._given.known(wait=wait), log_ns, wait=wait)

    def _composed_message(self, one: Stamped, log_ns: int) -> RobotMessage:
        self._note_position(one.pose)
        covariance = self._covariances.of(one.stamp_ns, one.pose)
        return self._pose_message(one.stamp_ns, self._map_frame, one.pose, covariance, log_ns)

    def _given_messages(self, ready: list[GivenPose], log_ns: int, *, wait: bool = True) -> list[RobotMessage]:
        messages = []
        for stamp_ns, pose in self._given.transforms(wait=wait):
            payload = encode_transform(stamp_ns, self._map_frame, self._given.frame, pose.translation, pose.rotation)
            messages.append(RobotMessage(Kind.TRANSFORM, payload, log_ns))
        for one in ready:
            messages.append(self._pose_message(one.stamp_ns, one.frame, one.pose, one.covariance, log_ns))
            self._note_position(self._given.in_map(one))
        return messages

    def _pose_message(
        self, stamp_ns: int, frame: str, pose: Rigid, covariance: Covariance | None, log_ns: int
    ) -> RobotMessage:
        payload = encode_odometry(stamp_ns, frame, pose.translation, pose.rotation, covariance, self._base)
        return RobotMessage(Kind.ODOMETRY, payload, log_ns)

    def _note_position(self, pose: Rigid | None) -> None:
        if pose is not None and is_finite(pose):
            self.position = pose.translation[0], pose.translation[1]

    def _pose_problems(self, now_ns: int) -> list[str]:
        given, base = self._given, self._base
        if self._from_tf:
            lines = self._words.between(self._map_frame, base, now_ns)
            if self._covariances.unplaced:
                lines.append(
                    f"{self._pose_topic}: covariances in {self._covariances.unplaced} are not used: transforms don't "
                    f"place it in {self._map_frame}"
                )
            if self._covariances.not_finite:
                lines.append(f"{self._pose_topic}: {self._covariances.not_finite} covariances are not finite")
            return lines
        lines = []
        if given.nameless:
            lines.append(f"{self._pose_topic} names no child_frame_id: its poses are taken as those of {base}")
        if given.unknown_body:
            lines.append(
                f"{self._pose_topic} gives poses of {given.unknown_body}, which are taken as those of {base}: no "
                f"transform between the two came"
            )
        if given.to_map is not None:
            lines += self._words.between(self._map_frame, given.frame, now_ns)
        elif self._topics[self._pose_topic].heard.count and given.frame != self._map_frame:
            frame = given.frame or "no frame"
            lines.append(f"{self._pose_topic} gives poses in {frame}; expected {self._map_frame}, or transforms to it")
        return lines

    def _sensor_problems(self, sensor: str, now_ns: int) -> list[str]:
        mountings = self._mountings
        lines = []
        if sensor not in mountings.known:
            lines = self._words.between(self._base, sensor, now_ns)
        elif sensor in mountings.moving:
            lines = [f"{sensor} moves on {self._base}: each of its clouds is placed by the transform of its stamp"]
        if mountings.lost[sensor]:
            lines.append(
                f"{mountings.lost[sensor]} clouds of {sensor} were dropped: they came before {self._base} -> {sensor}"
            )
        return lines
