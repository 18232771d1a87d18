"""The messages of a robot from a recording of ROS topics, whatever its file: which topics and frames, in which order.

A `Source` gives the topics of a recording and their messages as CDR. tf is read ahead for `LOOK_NS` to find the robot's
base and the frame of its map, and static transforms to the end: they hold from the beginning, as for a node that
subscribes to them. Nothing else of a recording is read before its turn.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from pydantic import ValidationError

from roughmap_ros.feed import POSE_TYPES, RobotFeed
from roughmap_ros.messages import (
    BadRosMessage,
    PoseRead,
    tf_cdr,
    transforms_of,
)
from roughmap_ros.messages.cdr import read_header
from roughmap_schemas.geometry import Quaternion, Vector
from roughmap_schemas.kinds import RobotMessage
from roughmap_schemas.ros2_sections import Ros2RobotConfig
from roughmap_schemas.transform import Transform
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Contents
from roughmap_service.formats.topics import BASES, Links, Role, Topic, base_frame, choose, no_poses

LOOK_NS: Final = 30_000_000_000
"""How much of tf is read ahead."""

MAX_FRAMES: Final = 10_000
"""Frames of tf that are looked at; robots have some hundred."""


class Raw(NamedTuple):
    """A message: its topic, its CDR, and when it was recorded, in ns."""

    topic: str
    data: bytes
    log_ns: int


class Source(Protocol):
    """An open recording. `topics` are those of the types that roughmap reads; all its messages are in [start, end].

    ``typed``: it holds the definitions of their types.
    """

    path: Path
    topics: list[Topic]
    start_ns: int
    end_ns: int
    typed: bool

    def messages(self, topics: Collection[str], until_ns: int | None = None) -> Iterator[Raw]:
        """Return the messages of some topics in the order in which they were recorded. Raises CloudFileFault."""


@dataclass(frozen=True)
class Plan:
    """What is read of a recording: the topics of the robot, the frame of its map, and its sensors as in `Contents`.

    `found` are those mounted that tf has; the others may be known from a recording before. `fixed` are the first static
    transforms of each frame.
    """

    topics: Ros2RobotConfig
    map_frame: str
    mounted: frozenset[str]
    placed: frozenset[str]
    found: frozenset[str]
    fixed: list[Transform]


def robot_messages(source: Source, options: ReadOptions) -> Iterator[Contents | RobotMessage]:
    """Return what the messages hold, then the messages. Raises CloudFileFault."""
    plan = plan_of(source, options)
    yield Contents(plan.map_frame, plan.mounted, plan.placed)
    feed = RobotFeed(plan.topics, plan.map_frame, plan.found)
    if plan.fixed and plan.topics.tf_static:
        yield from feed.take(plan.topics.tf_static, tf_cdr(plan.fixed), source.start_ns)
    span = max(source.end_ns - source.start_ns, 1)
    bad: dict[str, tuple[int, str]] = {}
    for raw in source.messages(feed.wanted()):
        options.reached((raw.log_ns - source.start_ns) / span)
        try:
            found = feed.take(raw.topic, raw.data, raw.log_ns)
        except BadRosMessage as error:
            number, first = bad.get(raw.topic, (0, str(error)))
            bad[raw.topic] = number + 1, first
            continue
        yield from found
    options.reached(1.0)
    yield from feed.end()
    for topic, (number, first) in bad.items():
        options.note(f"{source.path}: {topic}: {number:,} messages were left out, the first one since: {first}")
    for problem in feed.problems(source.start_ns):  # as of the start: that topics end in a recording is no problem
        options.note(f"{source.path}: {problem}")


def plan_of(source: Source, options: ReadOptions) -> Plan:
    """Return what is read, by the topics' types and by tf. Raises CloudFileFault if that is unclear."""
    links, fixed = _links(source)
    if options.topics is not None:
        topics = options.topics
        frames = frames_of(source, topics)
        poses = next((topic for topic in source.topics if topic.name == getattr(topics, topics.source)), None)
    else:
        chosen = choose(source.path, source.topics, partial(frame_of, source), options)
        frames, poses = dict(chosen.clouds), chosen.poses
        topics = _config(source, chosen.clouds, poses, _base(source, links, frames, poses))
    if poses is not None and poses.role in POSE_TYPES:
        first = _first_pose(source, poses)
        root = options.map_frame if first is None else first.frame_id
    else:
        above = links.up(topics.base)
        root = options.map_frame if options.map_frame in above else above[-1]
    map_frame = options.map_frame if links.holds(options.map_frame) else root
    if map_frame != options.map_frame:
        options.note(f"{source.path}: no frame {options.map_frame!r} in it; its poses are mapped in {map_frame!r}")
    mounted = frozenset(
        frame
        for frame in frames.values()
        if frame != topics.base and (frame not in options.sensors or options.sensors[frame].extrinsics == "transform")
    )
    found = frozenset(frame for frame in mounted if topics.base in links.up(frame))
    placed = frozenset(frame for frame in frames.values() if frame == topics.base)
    return Plan(topics, map_frame, mounted, placed, found, fixed)


def frame_of(source: Source, topic: Topic) -> str:
    """Return the frame of the first message of a topic, which begins with a header; "" if it has none."""
    raw = next(source.messages((topic.name,)), None)
    try:
        return "" if raw is None else read_header(raw.data).frame_id
    except BadRosMessage:
        return ""


def frames_of(source: Source, topics: Ros2RobotConfig) -> dict[Topic, str]:
    """Return the frames of configured topics of clouds; CloudFileFault if the recording has none of them."""
    found = {one: frame_of(source, one) for one in source.topics if one.name in {*topics.clouds, *topics.livox}}
    if not found:
        there = ", ".join(one.name for one in source.topics) or "none that roughmap reads"
        wanted = ", ".join((*topics.clouds, *topics.livox)) or "none"
        raise CloudFileFault(f"{source.path}: no clouds on the topics of ros2.robots ({wanted}); its topics: {there}")
    return found


def _base(source: Source, links: Links, frames: dict[Topic, str], poses: Topic | None) -> str:
    """Return the frame of the robot's base. CloudFileFault if neither odometry nor tf says where the robot is."""
    clouds = list(frames)
    if poses is None:
        base = base_frame(links, frames[clouds[0]])
        if base is None:
            raise no_poses(source.path, clouds[0], frames[clouds[0]], typed=source.typed)
        return base
    first = _first_pose(source, poses)
    if first is not None and first.body_frame_id:
        return first.body_frame_id
    above = links.up(frames[clouds[0]])
    return next((name for name in BASES if name in above), above[-1])


def _config(source: Source, clouds: Collection[Topic], poses: Topic | None, base: str) -> Ros2RobotConfig:
    def first(role: Role) -> str | None:
        return next((topic.name for topic in source.topics if topic.role == role and topic.messages), None)

    values: dict[str, object] = {
        role: [topic.name for topic in clouds if topic.role == role] for role in ("clouds", "livox")
    }
    if poses is not None:
        values[poses.role] = poses.name
    try:
        return Ros2RobotConfig.model_validate(
            {**values, "tf": first("tf"), "tf_static": first("tf_static"), "base": base}
        )
    except ValidationError as error:
        what = error.errors()[0]
        raise CloudFileFault(f"{source.path}: {what['input']!r}: {what['msg']}") from None


def _first_pose(source: Source, topic: Topic) -> PoseRead | None:
    _, read = POSE_TYPES[topic.role]
    for raw in source.messages((topic.name,)):
        try:
            return read(raw.data)
        except BadRosMessage:
            continue
    return None


def _links(source: Source) -> tuple[Links, list[Transform]]:
    """Return the links of tf in the first part of the recording, and the first static transform of each frame."""
    parents: dict[str, str] = {}
    places: dict[str, tuple[Vector, Quaternion]] = {}
    moving: set[str] = set()
    fixed: dict[str, Transform] = {}
    for role, until_ns in (("tf_static", None), ("tf", source.start_ns + LOOK_NS)):
        names = [topic.name for topic in source.topics if topic.role == role]
        for raw in source.messages(names, until_ns):
            try:
                transforms = transforms_of(raw.data)
            except BadRosMessage:
                continue
            for one in transforms[: MAX_FRAMES - len(parents)]:
                child, where = one.child_frame_id, (one.translation, one.rotation)
                parents[child] = one.parent_frame_id
                if role == "tf_static":
                    fixed.setdefault(child, replace(one, stamp_ns=0))
                elif places.setdefault(child, where) != where:
                    moving.add(child)
    return Links(parents, frozenset(moving)), list(fixed.values())
