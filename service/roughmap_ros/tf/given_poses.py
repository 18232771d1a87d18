"""Poses of a topic: turned into poses of the base, in the frame in which they are given."""

from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roughmap_ros.tf.composed_poses import ComposedPoses, Stamped
from roughmap_ros.tf.covariances import Covariance, moved
from roughmap_ros.tf.rigid import Rigid, compose, differ, is_finite, rotate
from roughmap_ros.tf.tree import Tree
from roughmap_schemas.geometry import SECOND_NS

WAIT_NS: Final = SECOND_NS
"""How far stamps go on while the first poses wait for the transforms of their body and frame."""

MAX_WAITING: Final = 1_000
"""Poses that wait: those of WAIT_NS at 1,000 Hz."""

SAME_M: Final = 1e-9
SAME_RAD: Final = 1e-9
"""How far transforms may differ that count as equal: rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class GivenPose:
    """The pose of ``body`` in ``frame``; the covariance (6, 6) is about the frame's axes, None if there is none."""

    stamp_ns: int
    frame: str
    body: str
    pose: Rigid
    covariance: Covariance | None


class GivenPoses:
    """The poses of one topic.

    Attributes:
        base: the body that they should be of.
        unknown_body: the body that was last taken for the base, since its transform is not known; "" if none was.
        nameless: poses without the name of a body, which are taken as the base's.
        frame: the frame of the newest pose; "" before the first.
    """

    def __init__(self, tree: Tree, map_frame: str, base: str, *, has_tf: bool) -> None:
        self.tree = tree
        self.map_frame = map_frame
        self.base = base
        self.unknown_body = ""
        self.nameless = 0
        self.frame = ""
        self.to_map: ComposedPoses | None = None
        self._has_tf = has_tf
        self._gave_up = not has_tf
        self._waiting: deque[GivenPose] = deque()
        self._said: Rigid | None = None
        self._since_ns = 0

    def take(self, given: GivenPose) -> list[GivenPose]:
        """Take a pose; return the poses of the base that are known now."""
        self.nameless += given.body == ""
        if given.frame != self.frame:
            self.frame, self._said, self._since_ns = given.frame, None, given.stamp_ns
            in_map = given.frame in ("", self.map_frame) or not self._has_tf
            self.to_map = None if in_map else ComposedPoses(self.tree, self.map_frame, given.frame)
        self._waiting.append(given)
        return self.known()

    def known(self, *, wait: bool = True) -> list[GivenPose]:
        """Return the poses that wait no more; without ``wait``, all."""
        waiting, ready = self._waiting, []
        while waiting:
            based = self._based(waiting[0])
            if based is None or not self._is_placed():
                patient = wait and not self._gave_up and len(waiting) < MAX_WAITING
                if patient and 0 <= waiting[-1].stamp_ns - waiting[0].stamp_ns < WAIT_NS:
                    break
                self._gave_up = True
            if based is None:
                self.unknown_body = waiting[0].body
                based = replace(waiting[0], body=self.base)
            waiting.popleft()
            ready.append(based)
        return ready

    def transforms(self, *, wait: bool = True) -> list[tuple[int, Rigid]]:
        """Return the new poses of `frame` in the map and their stamps, where they differ from the one before."""
        if self.to_map is None:
            return []
        changed = []
        fixed = self.to_map.fixed()
        poses = self.to_map.new(wait=wait) if fixed is None else [Stamped(0, fixed)]
        if self._said is None:  # of those before the first pose, one is enough
            before = [pose for pose in poses if pose.stamp_ns <= self._since_ns]
            poses = before[-1:] + poses[len(before) :]
        for stamp_ns, pose in poses:
            if self._said is None or differ(self._said, pose, SAME_M, SAME_RAD):
                self._said = pose
                changed.append((stamp_ns, pose))
        return changed

    def in_map(self, given: GivenPose) -> Rigid | None:
        """Return a pose in the map frame; None if its frame's place is not known."""
        if given.frame == self.map_frame:
            return given.pose
        place = self.tree.find(self.map_frame, given.frame, given.stamp_ns) if given.frame else None
        return None if place is None else compose(place, given.pose)

    def _is_placed(self) -> bool:
        known = self.to_map is None or self._said is not None
        return known or self.tree.chain(self.map_frame, self.frame) is not None

    def _based(self, given: GivenPose) -> GivenPose | None:
        if given.body in ("", self.base):
            self.unknown_body = ""
            return replace(given, body=self.base)
        base = self.tree.find(given.body, self.base, given.stamp_ns)
        if base is None:
            return None
        pose, covariance = compose(given.pose, base), given.covariance
        if not is_finite(pose):
            return None
        self.unknown_body = ""
        if covariance is not None and base.translation != (0.0, 0.0, 0.0) and np.isfinite(covariance).all():
            lever = rotate(given.pose.rotation, base.translation)
            covariance = moved(covariance, (0.0, 0.0, 0.0, 1.0), lever)
        return replace(given, body=self.base, pose=pose, covariance=covariance)
