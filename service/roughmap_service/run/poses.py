"""A robot's recent poses by stamp, and the messages that they came from."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Self

import numpy as np

from roughmap import Trajectory
from roughmap_schemas.geometry import Quaternion, Vector
from roughmap_service.run.pose_algebra import Floats, quaternion, triple

MAX_POSES = 20_000
"""Most poses kept of a robot, however long the history: 10 s at 2 kHz."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A robot's base in the map frame.

    ``covariance`` (6, 6) in map axes, None if the message has none. ``input`` is the odometry's input number,
    ``transform`` the transform's (0: none). ``leapt``: no motion explains how the robot got here from the pose before.
    """

    stamp_ns: int
    position: Vector
    rotation: Quaternion
    covariance: Floats | None
    input: int
    transform: int
    leapt: bool = False

    def to_state(self) -> list[Any]:
        """Return it as JSON values, exactly."""
        covariance = None if self.covariance is None else self.covariance.tolist()
        return [self.stamp_ns, self.position, self.rotation, covariance, self.input, self.transform, self.leapt]

    @classmethod
    def of_state(cls, state: Sequence[Any]) -> Self:
        """Restore what `to_state` returned, here or in a version without leaps."""
        stamp_ns, position, rotation, covariance, number, transform, *leapt = state
        matrix = None if covariance is None else np.array(covariance, np.float64)
        return cls(
            stamp_ns, triple(position), quaternion(rotation), matrix, number, transform, bool(leapt and leapt[0])
        )


@dataclass
class PoseBuffer:
    """One robot's poses by stamp, over the last ``history_ns`` up to the newest of them, at most ``max_poses``."""

    history_ns: int
    max_poses: int = MAX_POSES
    poses: list[Pose] = field(default_factory=list)
    horizon_ns: int = 0
    """Poses before this time are forgotten, but for one."""

    def insert(self, pose: Pose) -> int | None:
        """Add a pose, and forget what is too old. Return its place before that; None if there is one of its stamp."""
        at = bisect_left(self.poses, pose.stamp_ns, key=_stamp)
        if at < len(self.poses) and self.poses[at].stamp_ns == pose.stamp_ns:
            return None
        self.poses.insert(at, pose)
        return at

    def trim(self) -> None:
        """Forget what is too old."""
        if not self.poses:
            return
        self.horizon_ns = max(self.horizon_ns, self.poses[-1].stamp_ns - self.history_ns)
        # The last pose at or before the horizon stays, for times just after the horizon.
        keep = max(bisect_right(self.poses, self.horizon_ns, key=_stamp) - 1, 0)
        if len(self.poses) - keep > self.max_poses:
            keep = len(self.poses) - self.max_poses
            self.horizon_ns = max(self.horizon_ns, self.poses[keep].stamp_ns)
        del self.poses[:keep]

    def clear(self) -> None:
        """Forget all poses."""
        self.poses.clear()
        self.horizon_ns = 0

    def covers(self, first_ns: int, last_ns: int) -> bool:
        """Return whether there is a pose at or before the first time and one at or after the last."""
        return bool(self.poses) and self.poses[0].stamp_ns <= first_ns and self.poses[-1].stamp_ns >= last_ns

    def window(self, first_ns: int, last_ns: int) -> list[Pose]:
        """Return the poses from the last at or before ``first_ns`` to the first at or after ``last_ns``."""
        start = bisect_right(self.poses, first_ns, key=_stamp) - 1
        end = bisect_left(self.poses, last_ns, key=_stamp) + 1
        return self.poses[start:end]

    def named(self, references: Sequence[tuple[int, int]]) -> list[Pose]:
        """Return the poses with these (odometry input, transform input); KeyError for one that is not here."""
        wanted = set(references)
        found: dict[tuple[int, int], Pose] = {}
        for pose in reversed(self.poses):  # mostly the newest are named, and there may be thousands
            if len(found) == len(wanted):
                break
            if (pose.input, pose.transform) in wanted:
                found[pose.input, pose.transform] = pose
        return [found[reference] for reference in references]

    def to_state(self) -> list[Any]:
        """Return the poses as JSON values. It is exact: a float's shortest form reads back to the same bits."""
        return [pose.to_state() for pose in self.poses]


class NoTrajectory(ValueError):
    """Poses that are not a trajectory: none, or not in the order of their stamps."""


def trajectory(poses: Sequence[Pose], unknown_covariance: Floats) -> Trajectory:
    """Return poses as the core takes them; ``unknown_covariance`` (6, 6) stands in where a message has none.

    NoTrajectory if the core refuses them.
    """
    try:
        return Trajectory(
            np.array([p.stamp_ns for p in poses], np.int64),
            np.array([p.position for p in poses], np.float64),
            np.array([p.rotation for p in poses], np.float64),
            np.array([unknown_covariance if p.covariance is None else p.covariance for p in poses], np.float64),
        )
    except ValueError as error:
        raise NoTrajectory(str(error)) from None


def too_far_apart(poses: Sequence[Pose], max_gap_ns: float) -> bool:
    """Return whether two neighbours are farther apart in time than ``max_gap_ns`` (which may be infinite)."""
    return any(b.stamp_ns - a.stamp_ns > max_gap_ns for a, b in pairwise(poses))


def leaps(poses: Sequence[Pose]) -> bool:
    """Return whether the robot leapt between two of the poses."""
    return any(pose.leapt for pose in poses[1:])


def _stamp(item: Pose) -> int:
    return item.stamp_ns
