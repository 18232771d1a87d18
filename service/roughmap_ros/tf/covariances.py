"""Covariances of poses (6, 6), order x y z roll pitch yaw: in other axes, about another point, at another stamp."""

from typing import Final

import numpy as np
import numpy.typing as npt

from roughmap_ros.tf.rigid import Rigid, rotate
from roughmap_ros.tf.tree import Tree
from roughmap_schemas.geometry import SECOND_NS, Quaternion, Vector, rotation_matrix

Covariance = npt.NDArray[np.float64]

NOT_ESTIMATED: Final = -1.0
UNKNOWN_VARIANCE: Final = np.array([1e4, 1e4, 1e4, 1e2, 1e2, 1e2])
"""Variances from which on nothing was estimated, as in the contract. -1 means that too."""

SEEN_SHARE: Final = 0.2
"""An axis that leans by less than this (its sine) towards one without an estimate keeps its own."""

MAX_AGE_NS: Final = SECOND_NS
"""How old the covariance of a pose may be."""

MAX_KEPT: Final = 2_000
"""Covariances kept: those of a second at 1,000 Hz, and as many of poses that wait for their transforms."""


def moved(covariance: Covariance, turn: Quaternion, lever: Vector) -> Covariance | None:
    """Return the covariance in axes turned by ``turn``, about a point that lies at ``lever`` in the new axes.

    With the error (dt, dtheta) of a pose, a point at the lever errs by dt + dtheta x lever. Axes without an estimate
    have none afterwards either, and give nothing to the others. None if nothing was estimated, or a number overflows.
    """
    unknown = _unknown(covariance)
    if unknown.all() or (covariance[0, 0] == NOT_ESTIMATED and np.count_nonzero(covariance) == 1):
        return None
    known = np.where(unknown[:, None] | unknown[None, :], 0.0, covariance)
    r = np.array(rotation_matrix(turn))
    x, y, z = lever
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = r
    change[:3, 3:] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ r
    with np.errstate(all="ignore"):
        result = change @ known @ change.T
    result = 0.5 * (result + result.T)
    for block in (slice(0, 3), slice(3, 6)):
        hidden = np.flatnonzero((np.abs(r[:, unknown[block]]) > SEEN_SHARE).any(axis=1)) + block.start
        result[hidden, :] = result[:, hidden] = 0.0
        result[hidden, hidden] = NOT_ESTIMATED
    return result if np.isfinite(result).all() else None


def _unknown(covariance: Covariance) -> npt.NDArray[np.bool_]:
    variances = covariance.diagonal()
    return np.asarray((variances == NOT_ESTIMATED) | (variances >= UNKNOWN_VARIANCE), np.bool_)


class Covariances:
    """The covariances of a topic's poses, for poses that come from elsewhere."""

    def __init__(self, tree: Tree, map_frame: str, base: str) -> None:
        self.tree = tree
        self.map_frame = map_frame
        self.base = base
        self.not_finite = 0
        self.unplaced = ""
        """The frame of the last covariance that could not be turned into the map's axes."""
        self._kept: list[tuple[int, str, str, Covariance]] = []

    def take(self, stamp_ns: int, frame: str, body: str, covariance: Covariance | None) -> None:
        """Keep the covariance of a pose of ``body`` in ``frame``. Those of a clock before are forgotten."""
        kept = self._kept
        if kept and stamp_ns < kept[-1][0] - MAX_AGE_NS:
            kept.clear()
        if kept and stamp_ns <= kept[-1][0]:
            return
        if covariance is None or not covariance.any():
            return
        if not np.isfinite(covariance).all():
            self.not_finite += 1
            return
        kept.append((stamp_ns, frame, body, covariance))
        if len(kept) > MAX_KEPT:
            del kept[: MAX_KEPT // 2]

    def of(self, stamp_ns: int, pose: Rigid) -> Covariance | None:
        """Return the covariance of a pose of the base in the map: the newest that is not after it nor 1 s older."""
        for stamp, frame, body, covariance in reversed(self._kept):
            if stamp <= stamp_ns:
                return self._placed(stamp_ns, pose, frame, body, covariance) if stamp_ns - stamp <= MAX_AGE_NS else None
        return None

    def _placed(self, stamp_ns: int, pose: Rigid, frame: str, body: str, covariance: Covariance) -> Covariance | None:
        lever = (0.0, 0.0, 0.0)
        if body not in ("", self.base):
            at = self.tree.find(self.base, body, stamp_ns)
            if at is not None:
                x, y, z = at.translation
                lever = rotate(pose.rotation, (-x, -y, -z))
        if frame == self.map_frame:
            return covariance if lever == (0.0, 0.0, 0.0) else moved(covariance, (0.0, 0.0, 0.0, 1.0), lever)
        place = self.tree.find(self.map_frame, frame, stamp_ns)
        if place is None:
            self.unplaced = frame
            return None
        return moved(covariance, place.rotation, lever)
