"""A robot's recent poses and transforms, and the messages that they came from."""

import math
from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from roughmap import Trajectory
from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_schemas.geometry import Quaternion, Vector, rotation_matrix
from roughmap_service.run.pose_algebra import (
    Floats,
    angle_between,
    multiply,
    quaternion,
    rotate,
    triple,
    turn_covariance,
)

STALE_ROW = 10
"""Stale poses in a row, with rising stamps, after which the robot's clock counts as set back."""


MAX_POSES = 20_000
"""Most poses kept of a robot, however long the history: 10 s at 2 kHz."""

MAX_TRANSFORMS = 1_000
"""Transforms kept of a robot. One per frame is needed; the others serve odometry that arrives late."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A robot's base in the map frame.

    ``covariance`` (6, 6) in map axes, None if the message has none. ``input`` is the odometry's input number,
    ``transform`` the transform's (0: none).
    """

    stamp_ns: int
    position: Vector
    rotation: Quaternion
    covariance: Floats | None
    input: int
    transform: int


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """The pose of a child frame in the map frame, valid from a stamp on."""

    stamp_ns: int
    input: int
    translation: Vector
    rotation: Quaternion


@dataclass
class PoseBuffer:
    """One robot's poses by stamp, over `history_ns`, and its transforms to the map frame.

    It depends on nothing but the messages and their order, so that a replay has the same poses.
    """

    frame_id: str
    history_ns: int
    jump_m: float
    jump_rad: float
    max_poses: int = MAX_POSES
    max_transforms: int = MAX_TRANSFORMS
    poses: list[Pose] = field(default_factory=list)
    transforms: dict[str, list[StampedTransform]] = field(default_factory=dict)
    horizon_ns: int = 0
    stale_row: int = 0
    stale_stamp_ns: int = -1
    jumps: int = 0

    def add(self, odometry: Odometry, number: int) -> tuple[PoseReason | None, bool]:
        """Add a pose. Return why it is rejected (None: added), and whether it shows that the clock was set back."""
        pose = self._in_map_frame(odometry, number)
        if pose is None:
            return PoseReason.POSE_FRAME, False
        # Rotated into map axes, the largest numbers may overflow.
        if odometry.covariance_fault or (pose.covariance is not None and not np.isfinite(pose.covariance).all()):
            return PoseReason.BAD_COVARIANCE, False
        was_reset = False
        if pose.stamp_ns < self.horizon_ns:
            rising = pose.stamp_ns > self.stale_stamp_ns
            self.stale_row = self.stale_row + 1 if rising else 1
            self.stale_stamp_ns = pose.stamp_ns
            if self.stale_row < STALE_ROW:
                return PoseReason.STALE, False
            self.poses.clear()
            self.horizon_ns = 0
            was_reset = True
        self.stale_row, self.stale_stamp_ns = 0, -1
        at = bisect_left(self.poses, pose.stamp_ns, key=_stamp)
        if at < len(self.poses) and self.poses[at].stamp_ns == pose.stamp_ns:
            return PoseReason.DUPLICATE, False
        self.poses.insert(at, pose)
        self._trim()
        return None, was_reset

    def add_transform(self, transform: Transform, number: int) -> PoseReason | None:
        """Add a transform. Return `pose_frame` if its parent is not the map's frame."""
        if transform.parent_frame_id != self.frame_id:
            return PoseReason.POSE_FRAME
        new = StampedTransform(
            transform.stamp_ns, number, triple(transform.translation), quaternion(transform.rotation)
        )
        row = self.transforms.setdefault(transform.child_frame_id, [])
        before = bisect_right(row, new.stamp_ns, key=_stamp)
        if before and self._jumped(row[before - 1], new):
            self.jumps += 1
        insort(row, new, key=_stamp)
        if sum(len(r) for r in self.transforms.values()) > self.max_transforms:
            self._forget_transform()
        return None

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

    def _trim(self) -> None:
        self.horizon_ns = max(self.horizon_ns, self.poses[-1].stamp_ns - self.history_ns)
        # The last pose at or before the horizon stays, for times just after the horizon.
        keep = max(bisect_right(self.poses, self.horizon_ns, key=_stamp) - 1, 0)
        if len(self.poses) - keep > self.max_poses:
            keep = len(self.poses) - self.max_poses
            self.horizon_ns = max(self.horizon_ns, self.poses[keep].stamp_ns)
        del self.poses[:keep]

    def _forget_transform(self) -> None:
        """Forget the first logged transform of the frame with most of them.

        So a static transform is not pushed out by a frequent one, nor those of a new clock by those of the clock
        before, whose stamps may be later.
        """
        child, row = max(self.transforms.items(), key=lambda item: (len(item[1]), -min(t.input for t in item[1])))
        row.remove(min(row, key=lambda t: t.input))
        if not row:
            del self.transforms[child]

    def _in_map_frame(self, odometry: Odometry, number: int) -> Pose | None:
        position, rotation = triple(odometry.position), quaternion(odometry.rotation)
        if odometry.frame_id == self.frame_id:
            return Pose(odometry.stamp_ns, position, rotation, odometry.covariance, number, 0)
        row = self.transforms.get(odometry.frame_id, [])
        before = bisect_right(row, odometry.stamp_ns, key=_stamp)
        if not before:
            return None
        transform = row[before - 1]
        turn = rotation_matrix(transform.rotation)
        moved = rotate(turn, position)
        covariance = None if odometry.covariance is None else turn_covariance(turn, odometry.covariance)
        t = transform.translation
        placed = t[0] + moved[0], t[1] + moved[1], t[2] + moved[2]
        if not all(map(math.isfinite, placed)):
            return None  # the sum of finite numbers may overflow
        return Pose(
            odometry.stamp_ns, placed, multiply(transform.rotation, rotation), covariance, number, transform.input
        )

    def _jumped(self, old: StampedTransform, new: StampedTransform) -> bool:
        step = math.dist(old.translation, new.translation)
        return step > self.jump_m or angle_between(old.rotation, new.rotation) > self.jump_rad

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values. It is exact: a float's shortest form reads back to the same bits."""
        return {
            "poses": [
                [p.stamp_ns, p.position, p.rotation, None if p.covariance is None else p.covariance.tolist(), p.input,
                 p.transform]
                for p in self.poses
            ],
            "transforms": {
                child: [[t.stamp_ns, t.input, t.translation, t.rotation] for t in row]
                for child, row in self.transforms.items()
            },
            "horizon_ns": self.horizon_ns,
            "stale": [self.stale_row, self.stale_stamp_ns],
            "jumps": self.jumps,
        }  # fmt: skip

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `to_state` returned."""
        self.poses = [
            Pose(s, triple(p), quaternion(r), None if c is None else np.array(c, np.float64), i, t)
            for s, p, r, c, i, t in state["poses"]
        ]
        self.transforms = {
            child: [StampedTransform(s, i, triple(t), quaternion(r)) for s, i, t, r in row]
            for child, row in state["transforms"].items()
        }
        self.horizon_ns = state["horizon_ns"]
        self.stale_row, self.stale_stamp_ns = state["stale"]
        self.jumps = state["jumps"]


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


def too_fast(poses: Sequence[Pose], max_speed: float, max_turn: float) -> bool:
    """Return whether two neighbours imply more than ``max_speed`` (m/s) or ``max_turn`` (rad/s)."""
    for a, b in pairwise(poses):
        seconds = (b.stamp_ns - a.stamp_ns) * 1e-9
        if math.dist(a.position, b.position) > max_speed * seconds:
            return True
        if angle_between(a.rotation, b.rotation) > max_turn * seconds:
            return True
    return False


def _stamp(item: Pose | StampedTransform) -> int:
    return item.stamp_ns
