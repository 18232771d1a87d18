"""Leaps: poses that no motion explains, such as the corrections of a localisation."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from roughmap_schemas.geometry import Vector
from roughmap_service.run.pose_algebra import distance, rotation_vector
from roughmap_service.run.poses import Pose

MOTION_NS = 100_000_000
"""Time over which a robot's velocity is taken: over less, the noise of its poses would be most of it."""

LOOKED_AT = 400
"""Poses that are looked at for it: where each one leaps, as with two sources, there would be no end."""

MAX_TURN_LEAP = 0.3
"""Radians by which a turn may differ from the robot's motion, beside what `MAX_TURN_ACCELERATION` explains."""

MAX_TURN_ACCELERATION = 50.0
"""rad/s^2."""


@dataclass(frozen=True, slots=True)
class Leap:
    """A pose ``metres`` and ``radians`` from where the robot's motion led, ``seconds`` after the pose before."""

    metres: float
    radians: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Motion:
    """A mean velocity in m/s and a mean turn rate in rad/s, as a vector, in map axes."""

    velocity: Vector
    turn: Vector


def find_leap(
    poses: Sequence[Pose], at: int, max_leap: float, max_acceleration: float, max_speed: float
) -> Leap | None:
    """Return the leap from the pose before to the one ``at`` this place; None if a motion explains it.

    A pose leaps if it is further than ``max_leap`` + ``max_acceleration`` dt^2 / 2 from where the robot's velocity
    would have brought it, if its rotation differs likewise, or if it moved more than ``max_leap`` and faster than
    ``max_speed``. The velocity is that of the 0.1 s or more before, since the last leap; it does not judge while there
    are none.
    """
    if not at:
        return None
    last, pose = poses[at - 1], poses[at]
    seconds = (pose.stamp_ns - last.stamp_ns) * 1e-9
    step = distance(pose.position, last.position)
    motion = motion_before(poses, at)
    if motion is None:
        leapt = step > max_leap and step > max_speed * seconds
        return Leap(step, 0.0, seconds) if leapt else None
    expected = [p + v * seconds for p, v in zip(last.position, motion.velocity, strict=True)]
    metres = distance(pose.position, expected)
    turned = rotation_vector(last.rotation, pose.rotation)
    radians = distance(turned, [w * seconds for w in motion.turn])
    squared = seconds * seconds / 2.0
    if (
        metres > max_leap + max_acceleration * squared
        or (step > max_leap and step > max_speed * seconds)
        or radians > MAX_TURN_LEAP + MAX_TURN_ACCELERATION * squared
    ):
        return Leap(metres, radians, seconds)
    return None


def motion_before(poses: Sequence[Pose], at: int) -> Motion | None:
    """Return the motion over 0.1 s or more without a leap before a pose; None if the last 400 poses have none."""
    end, first = at - 1, max(at - 1 - LOOKED_AT, 0)
    while end > first:
        if poses[end].leapt:
            end -= 1
            continue
        since = bisect_right(poses, poses[end].stamp_ns - MOTION_NS, first, end + 1, key=_stamp) - 1
        start = next((k for k in range(end, since, -1) if poses[k].leapt), max(since, first))
        if (span := poses[end].stamp_ns - poses[start].stamp_ns) >= MOTION_NS:
            seconds = span * 1e-9
            a, b = poses[start], poses[end]
            x, y, z = ((q - p) / seconds for p, q in zip(a.position, b.position, strict=True))
            u, v, w = (t / seconds for t in rotation_vector(a.rotation, b.rotation))
            return Motion((x, y, z), (u, v, w))
        end = start - 1  # before the leap
    return None


def _stamp(pose: Pose) -> int:
    return pose.stamp_ns
