"""Which topics of a recording are a robot's clouds and poses, by their types. What is unclear is said in one line."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

from roughmap_ros.messages.types import LIVOX, LIVOX_ROS1, ODOMETRY, POINT_CLOUD, POSE, POSE_STAMPED, TF, TF_ROS1
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault

Role = Literal["clouds", "livox", "odometry", "pose", "pose_stamped", "tf", "tf_static"]

ROLES: Final[Mapping[str, Role]] = {
    POINT_CLOUD: "clouds",
    LIVOX: "livox",
    LIVOX_ROS1: "livox",
    ODOMETRY: "odometry",
    POSE: "pose",
    POSE_STAMPED: "pose_stamped",
    TF: "tf",
    TF_ROS1: "tf",
    "foxglove.PointCloud": "clouds",
    "foxglove.Odometry": "odometry",
    "foxglove.PoseInFrame": "pose_stamped",
    "foxglove.FrameTransform": "tf",
    "foxglove.FrameTransforms": "tf",
}
"""What a topic may be, by its type."""

CLOUDS: tuple[Role, ...] = ("clouds", "livox")
POSES: tuple[Role, ...] = ("odometry", "pose", "pose_stamped")

COMMANDS = re.compile(r"goal|initial_?pose|target", re.IGNORECASE)
"""In the names of topics whose poses say where a robot shall be, or where a person says that it is."""

BASES = ("base_link", "base_footprint")

MAX_LISTED = 12


class Topic(NamedTuple):
    """A topic of a recording that may be a robot's: what it is by its type, and how many messages it has."""

    name: str
    role: Role
    messages: int


def role_of(type_name: str, topic: str) -> Role | None:
    """Return what a topic may be; None if its type is not read."""
    role = ROLES.get(type_name)
    return "tf_static" if role == "tf" and topic.endswith("tf_static") else role


def absolute(topic: str) -> str:
    """Return a topic's name with its first slash: ROS 1 may leave it out."""
    return topic if topic.startswith("/") else f"/{topic}"


class Links(NamedTuple):
    """Links of a tf tree, child to parent; `moving` are the children of those that changed."""

    parents: Mapping[str, str]
    moving: frozenset[str]

    def up(self, frame: str) -> list[str]:
        """Return the frame and those above it."""
        found = [frame]
        while (parent := self.parents.get(found[-1])) is not None and parent not in found:
            found.append(parent)
        return found

    def holds(self, frame: str) -> bool:
        """Return whether a link begins or ends at the frame."""
        return frame in self.parents or frame in self.parents.values()


class Chosen(NamedTuple):
    """The topics of a robot's clouds, with the frame of each, and of its poses; None: its poses come from tf."""

    clouds: Mapping[Topic, str]
    poses: Topic | None


def choose(path: Path, topics: Sequence[Topic], frame_of: Callable[[Topic], str], options: ReadOptions) -> Chosen:
    """Return the topics that are read; `frame_of` gives the frame of a topic's first cloud.

    Raises CloudFileFault with the candidates and the option that chooses if there is no choice, or more than one.
    """
    clouds = _clouds(path, topics, frame_of, options)
    return Chosen(clouds, None if options.poses else _poses(path, topics, options))


def _clouds(
    path: Path, topics: Sequence[Topic], frame_of: Callable[[Topic], str], options: ReadOptions
) -> dict[Topic, str]:
    there = [topic for topic in topics if topic.role in CLOUDS and topic.messages]
    if options.clouds:
        return {topic: frame_of(topic) for topic in _named(path, there, options.clouds, "--clouds", "clouds")}
    if not there:
        others = _listed(topics) or "none that roughmap reads"
        raise CloudFileFault(f"{path}: no clouds in it; expected PointCloud2 or Livox topics, found {others}")
    frames = {topic: frame_of(topic) for topic in there}
    found = {topic: frame for topic, frame in frames.items() if frame in options.sensors}
    if not found and not options.any_sensor:
        frame = next(iter(frames.values()))
        listed = ", ".join(f"{topic.name} in {frame!r}" for topic, frame in frames.items())
        raise CloudFileFault(
            f"{path}: its clouds are of no configured sensor ({listed}); use --range-sigma METRES, or add "
            f"[sensors.{frame}] to the configuration"
        )
    found = found or {topic: frame for topic, frame in frames.items() if frame != options.map_frame} or frames
    # Topics of configured sensors are all read, but the same sensor's clouds only once.
    configured = all(frame in options.sensors for frame in found.values())
    if len(found) > 1 and (not configured or len(set(found.values())) < len(found)):
        raise CloudFileFault(f"{path}: several topics of clouds: {_listed(found)}; choose by --clouds TOPIC")
    return found


def _poses(path: Path, topics: Sequence[Topic], options: ReadOptions) -> Topic | None:
    there = [topic for topic in topics if topic.role in POSES and topic.messages]
    if options.odometry is not None:
        return _named(path, there, (options.odometry,), "--odometry", "poses")[0]
    for role in POSES:
        found = [topic for topic in there if topic.role == role and not COMMANDS.search(topic.name)]
        if len(found) > 1:
            raise CloudFileFault(f"{path}: several topics of poses: {_listed(found)}; choose by --odometry TOPIC")
        if found and (role == "odometry" or not any(topic.role == "tf" and topic.messages for topic in topics)):
            return found[0]
    return None


def _named(path: Path, there: Sequence[Topic], names: Sequence[str], option: str, what: str) -> list[Topic]:
    by_name = {topic.name: topic for topic in there}
    missing = next((name for name in names if name not in by_name), None)
    if missing is not None:
        raise CloudFileFault(f"{path}: {option} {missing}: no such topic of {what}; found {_listed(there) or 'none'}")
    return [by_name[name] for name in names]


def _listed(topics: Sequence[Topic] | Mapping[Topic, str]) -> str:
    listed = [f"{topic.name} ({topic.messages:,} messages)" for topic in topics]
    return ", ".join(listed[:MAX_LISTED] + ["..."] * (len(listed) > MAX_LISTED))


def base_frame(links: Links, frame: str) -> str | None:
    """Return the frame of the robot that carries the sensor with that frame; None if tf does not say where it goes.

    It is base_link or base_footprint if the sensor hangs on one that has a parent, else the first frame that moves.
    """
    above = links.up(frame)
    named = next((name for name in BASES if name in above[:-1]), None)
    return named or next((name for name in above if name in links.moving), None)


def no_poses(path: Path, cloud: Topic, frame: str, *, typed: bool) -> CloudFileFault:
    """Return the fault of a recording without poses: how kiss-icp makes them, and how they are given.

    kiss-icp reads only bags that hold the definitions of their types; older ones of rosbag2 don't (not ``typed``).
    """
    bag, first, topic = path, "", cloud.name
    if not typed:
        bag = path.with_name(f"{path.name.split('.')[0]}_typed")
        first = f"rosbags-convert --src {path} --dst {bag} --src-typestore ros2_humble && "
    return CloudFileFault(
        f"{path}: no odometry in it, and no tf from a map to {frame!r}; let kiss-icp find the trajectory: "
        f"pip install kiss-icp 'rosbags<0.12' && {first}kiss_icp_pipeline --dataloader rosbag --topic {topic} {bag}, "
        f"then give it by --poses results/latest/{bag.name.split('.')[0]}_poses_kitti.txt"
    )
