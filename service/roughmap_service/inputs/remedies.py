"""What an operator is told of a lost stream: one sentence with its subject, the cause, the figures and the remedy."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from roughmap_schemas import Config, Keys
from roughmap_schemas.reasons import MEANING, PointReason
from roughmap_service.host.counters import OTHERS
from roughmap_service.host.log_lines import printable
from roughmap_service.inputs.losses import Cause, Outcome
from roughmap_service.run.point_times import SHARES

MAX_TEXT, MAX_FIGURES = 900, 300
"""Characters of a sentence and of its figures: they quote what comes from outside, and a status may have 32."""

POSES, CLOUDS, TRANSFORMS, ANY_CLOUDS, MESSAGES = "odometry", "clouds", "transform", "points", "messages"
"""The streams of a subject: a robot's poses and transforms, a sensor's clouds, a robot's clouds that could not be read,
so that their sensor is not known, and all that a robot sends if none of it may be taken."""


class Figures(NamedTuple):
    """Figures of a loss, such as "the newest pose is 37.0 s behind", and a better remedy than the usual one.

    ``certain``: they name the cause, whatever else may be known of the sender.
    """

    text: str = ""
    remedy: str = ""
    certain: bool = False


@dataclass(frozen=True)
class Subject:
    """Who is told about: a robot, or one of its sensors."""

    robot: str
    frame_id: str | None = None

    def __str__(self) -> str:
        if self.robot == OTHERS:
            return "robots without a valid name"
        text = f"robot {self.robot}" if self.frame_id is None else f"robot {self.robot} sensor {self.frame_id}"
        return printable(text)  # sentences are read line by line


def toml_key(name: str) -> str:
    """Return a name as a part of a TOML key: as it is where it may be, else in quotes."""
    if re.fullmatch(r"[A-Za-z0-9_-]+", name):
        return name
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")


def robot_table(robot: str) -> str:
    """Return the head of a robot's table in the configuration, such as ``[robots.r1]``."""
    return f"[robots.{toml_key(robot)}]"


def sensor_table(config: Config, robot: str, frame_id: str) -> str:
    """Return the head of the table that a sensor's settings come from: the robot's own if it has one."""
    own = config.robots.get(robot)
    if own is not None and frame_id in own.sensors:
        return f"[robots.{toml_key(robot)}.sensors.{toml_key(frame_id)}]"
    return f"[sensors.{toml_key(frame_id)}]"


def time_form_remedy(seen: str, table: str) -> str:
    """Return what to do about times of unclear meaning; ``seen`` is what was seen of them, ``table`` the sensor's."""
    if SHARES in seen:
        return f'let its driver send times in s, ms, us or ns; time_field = "none" in {table} maps without them'
    return f'set time_field, time_unit and time_origin in {table}; time_field = "none" ignores the times'


CLOUD_REMEDIES: Final = {
    "pose_gap": "publish poses more often, or raise input.max_pose_gap",
    "pose_jump": (
        "look at what publishes {odometry}: two programs, a localisation that jumps, or stamps that come in bursts; "
        "raise input.max_leap if the robot does move like that"
    ),
    "no_pose": "publish its odometry on {odometry}, on the clock of {sensor}; raise input.max_wait if it comes later",
    "late": "check that {sensor} and the odometry use one clock; raise input.pose_history if its clouds take that long",
    "too_many_tiles": "set max_range in {table}, raise map.cell_size, or raise map.max_new_tiles or map.max_tiles",
    "empty": "look at what its driver leaves out",
    "clock_reset": (
        "if two programs publish on {odometry}, stop one; else let the robot's clock be steered (chrony, PTP), not set "
        "while it runs"
    ),
    "clock_offset": "check that {sensor} and the odometry use one clock, or set time_offset in {table}",
    "time_form": 'set time_field, time_unit and time_origin in {table}; time_field = "none" ignores the times',
    "no_extrinsics": (
        "publish the transform from the robot's base frame to {sensor} on {transform}, or set translation and rotation "
        "instead of extrinsics in {table}"
    ),
}
"""A cloud's reasons but `overload`, which is a problem of the service."""

NO_POSE_OF_ROS: Final = (
    "`roughmap doctor` names the ROS topic or transform that is missing; raise input.max_wait if poses come later"
)

POINT_REMEDIES: Final = {
    "not_finite": "check its driver: x, y and z of its points are NaN or infinite",
    "no_return": "check that its window is clean and free, and that it sees more than the sky",
    "duplicate_return": "check its driver: its points are equal, as if nothing came back",
    "time": 'set time_unit and time_origin in {table}; time_field = "none" ignores the points\' times',
    "no_pose": "check time_unit and time_origin in {table}: the times of its points are not among the poses'",
    "self": "check exclude in {table}: its boxes, in the robot's frame, hold nearly all points",
    "range": "check min_range and max_range in {table}, and that the points are in metres",
    "ceiling": "raise ceiling in {table}, or check its rotation",
    "covariance": "look at the covariance in {odometry}, and set pose_covariance in {robot_table}",
    "uncertain": "raise map.max_horizontal_radius or map.max_vertical_sigma, which needs a new run (--fresh)",
    "bounds": "check map.bounds, and whether the robot's poses are in the map's frame",
}

POSE_REMEDIES: Final = {
    "duplicate": "give each pose its own stamp; if two programs publish on {odometry}, stop one of them",
    "stale": "check its clock; if two programs publish on {odometry}, stop one of them",
    "ahead": "check its clock: its stamps leap forward and back",
    "out_of_order": "publish its poses in the order of their stamps; if two programs publish on {odometry}, stop one",
    "frozen": "stamp each pose with the time at which the robot was there",
    "pose_frame": 'publish a transform from its frame to "{map_frame}" on {transform}, or poses in "{map_frame}"',
    "bad_covariance": "correct the covariance, or send none: input.pose_sigma stands in",
}

REFUSED_REMEDIES: Final = {
    "bad_key": "name the robot, and its keys, in that way",
    "bad_encoding": "publish protobuf messages with the encodings in schemas/README.md",
    "bad_message": "publish the messages that schemas/README.md describes",
    "too_large": "send smaller messages, or raise input.max_message or input.max_points",
    "unknown_sensor": "add {table} with its translation, rotation and range_sigma",
    "unknown_robot": "add {quoted_robot} to input.robots",
    "unset_stamp": "",  # the refusal says it
    "duplicate": "nothing is lost; to map a recording again, reset the map (control/reset) before it is sent again",
}
"""The reasons of refusals but those that are problems of the service: `busy`, `log_unavailable`, `shutting_down`."""

REMEDIES: Final = {
    "cloud": CLOUD_REMEDIES, "point": POINT_REMEDIES, "pose": POSE_REMEDIES, "refused": REFUSED_REMEDIES,
}  # fmt: skip
"""By kind and reason of the cause: all that a sender can be told."""

SERVICES_OWN: Final = frozenset({"overload", "busy", "log_unavailable", "shutting_down"})
"""Reasons that say nothing about the sender: the service has its own problem for each."""

CAUSES: Final = {
    "cloud": {
        "pose_gap": "neighbouring poses are more than input.max_pose_gap = {max_pose_gap} s apart",
        "pose_jump": "the robot's pose leapt within their time",
        "no_pose": "no poses around their stamps within {max_wait} s (input.max_wait)",
        "late": "they are older than the poses kept (input.pose_history = {pose_history} s)",
        "too_many_tiles": "they need more tiles than map.max_new_tiles or map.max_tiles allow",
        "empty": "they are empty",
        "clock_reset": "the stamps of the robot's poses went back while they waited",
        "clock_offset": "the clock of {sensor} differs from the robot's",
        "time_form": "what the times of its points mean is unclear",
        "no_extrinsics": "the sensor's mounting has not come yet",
    },
    "pose": {
        "duplicate": "they have the stamps of poses that came before",
        "stale": "they are older than the poses kept (input.pose_history = {pose_history} s)",
        "ahead": "each has a stamp far ahead of the others",
        "out_of_order": "they are older than the poses before them",
        "frozen": "all have one stamp",
        "pose_frame": 'no transform leads from their frame to the map\'s, "{map_frame}"',
        "bad_covariance": "their covariance is invalid",
    },
}
"""The cause in words; of points it is the reason's meaning, of refused messages the refusal's own text."""


PLURALS: Final = {
    POSES: "poses", CLOUDS: "clouds", TRANSFORMS: "transforms", ANY_CLOUDS: "clouds", MESSAGES: "messages",
}  # fmt: skip
"""What the messages of each stream are called."""


def sentence(
    config: Config, subject: Subject, cause: Cause, last: Sequence[Outcome], figures: Figures, stream: str = CLOUDS
) -> str:
    """Return what is told of a stream that was lost for ``cause``; ``last`` are its last messages."""
    words = _words(config, subject)
    remedies = REMEDIES[cause.kind]
    if cause.kind == "cloud" and subject.robot in config.ros2.robots:
        remedies = {**remedies, "no_pose": NO_POSE_OF_ROS}
    remedy = figures.remedy or remedies[cause.reason].format_map(words)
    if cause.kind == "point":
        text = f"{subject}: {_points_lost(last, cause)}"
    else:
        what, done = PLURALS[stream], "mapped" if stream == CLOUDS and cause.kind == "cloud" else "taken"
        text = f"{subject}: {_messages_lost(last, what, done)}"
    parts = [shortened(figures.text, MAX_FIGURES)] if figures.text else []
    if cause.kind in CAUSES:
        parts = [CAUSES[cause.kind][cause.reason].format_map(words), *parts]
    return in_one_line(f"{text}: {'; '.join([*parts, remedy] if remedy else parts)}")


def points_lost(config: Config, subject: Subject, reason: str, lost: int, number: int) -> str:
    """Return what is told of a mapped cloud of which ``lost`` of ``number`` points were rejected for a reason."""
    remedy = POINT_REMEDIES[reason].format_map(_words(config, subject))
    what = f"{lost:,} of the {number:,} points of a cloud were rejected as {reason} ({MEANING[PointReason][reason]})"
    return in_one_line(f"{subject}: {what}: {remedy}")


def lost_on_the_way(robot: str, kind: str, number: int) -> str:
    """Return what is told of ``number`` messages of a kind that were lost since the service heard of the robot."""
    what = f"{number:,} of its {kind} messages were" if number > 1 else f"one of its {kind} messages was"
    return f"robot {robot}: {what} lost on the way so far; publish with CongestionControl.BLOCK, or ingest them"


def in_one_line(text: str) -> str:
    """Return a sentence as it is told: not too long, and with nothing in it that would look like another line."""
    return shortened(printable(text))


def shortened(text: str, most: int = MAX_TEXT) -> str:
    """Return the text, its middle left out if it is longer than that: cause and remedy stand at its ends."""
    return text if len(text) <= most else f"{text[: most // 2 - 3]} ... {text[3 - most // 2 :]}"


def _words(config: Config, subject: Subject) -> dict[str, str]:
    keys, robot, frame = Keys(config.map.name, config.keys), subject.robot, subject.frame_id
    return {
        "odometry": keys.odometry(robot),
        "transform": keys.transform(robot),
        "map_frame": config.map.frame_id,
        "robot_table": robot_table(robot),
        "quoted_robot": json.dumps(robot),
        "sensor": "its sensor" if frame is None else frame,
        "table": sensor_table(config, robot, frame or ""),
        "max_pose_gap": f"{config.input.max_pose_gap:g}",
        "max_wait": f"{config.input.max_wait:g}",
        "pose_history": f"{config.input.pose_history:g}",
    }


def _messages_lost(last: Sequence[Outcome], what: str, done: str) -> str:
    number, bad = len(last), sum(outcome.cause is not None for outcome in last)
    if number == 1:
        return f"its last {what.removesuffix('s')} was not {done}"
    if bad == number:
        return f"none of its last {number} {what} was {done}"
    return f"{bad} of its last {number} {what} {'was' if bad == 1 else 'were'} not {done}"


def _points_lost(last: Sequence[Outcome], cause: Cause) -> str:
    """Return the share of points that the cause took of the clouds that were lost by it."""
    lost = [outcome for outcome in last if outcome.cause == cause]
    rejected = sum(outcome.rejected.get(cause.reason, 0) for outcome in lost)
    points = sum(outcome.accepted + sum(outcome.rejected.values()) for outcome in lost)
    share = min(100.0 * rejected / points, 100.0 if rejected == points else 99.9) if points else 100.0
    number = len(last)
    clouds = f"the last {number} clouds" if len(lost) == number else f"{len(lost)} of its last {number} clouds"
    clouds = clouds if number > 1 else "its last cloud"
    meaning = MEANING[PointReason][cause.reason]
    return f"{share:.3g} % of the points of {clouds} were rejected as {cause.reason} ({meaning})"
