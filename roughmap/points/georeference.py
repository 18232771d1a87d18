"""Placement of a scan without a map (eq. 1)."""

from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8, I8, U1, Flags, Scalar
from roughmap.jit import inline, kernel
from roughmap.points.moving import moving_scratch, place_moving
from roughmap.points.place import BLOCK, COMMON, MOUNT, PLANES, STRIDE, UP, S, X, Y, Z, place_still, pose_at
from roughmap.points.propagation import counted_variance
from roughmap.points.scan import Limits, Noise, Scan, scan_rules
from roughmap.points.strided import read_points, source_of
from roughmap.points.trajectory import Trajectory

__all__ = ["Limits", "Noise", "Placed", "Scan", "georeference"]


class Placed(NamedTuple):
    """A scan in the map frame. Rows of rejected points are NaN, and False in ``up``.

    ``points`` (N, 3) metres; ``covariance`` (N, 3, 3); ``reason`` (N,) of `PointReason`, 0 = kept. ``common``,
    ``mount`` (N,): the parts of the height's variance that come from the pose and from the mounting, square metres.
    ``up`` (N,): whether the point lies more than 0.5 rad above the sensor's horizon, so that it can't be ground.
    """

    points: F8
    covariance: F8
    reason: U1
    common: F8
    mount: F8
    up: Flags


@inline
def _write(P: F8, block_reason: U1, first: int, size: int, placed: Scalar) -> None:
    points, covariance, reason, common, mount, up = placed
    for n in range(size):
        kept = block_reason[n] == 0
        common[first + n] = counted_variance(P[COMMON, n]) if kept else np.nan
        mount[first + n] = counted_variance(P[MOUNT, n]) if kept else np.nan
        up[first + n] = (P[UP, n] != 0.0) & kept
    for n in range(size):
        kept = block_reason[n] == 0
        reason[first + n] = block_reason[n]
        points[first + n, 0] = P[X, n] if kept else np.nan
        points[first + n, 1] = P[Y, n] if kept else np.nan
        points[first + n, 2] = P[Z, n] if kept else np.nan
        c = covariance[first + n]
        c[0, 0] = P[S, n] if kept else np.nan
        c[0, 1] = P[S + 1, n] if kept else np.nan
        c[0, 2] = P[S + 2, n] if kept else np.nan
        c[1, 1] = P[S + 3, n] if kept else np.nan
        c[1, 2] = P[S + 4, n] if kept else np.nan
        c[2, 2] = P[S + 5, n] if kept else np.nan
        c[1, 0] = c[0, 1]
        c[2, 0] = c[0, 2]
        c[2, 1] = c[1, 2]


@kernel
def _place_blocks(
    source: Scalar, offsets: I8, moving: bool, stamp: int, path: Scalar, max_gap_ns: float, posed: bool, pose: Scalar,
    rules: Scalar, planes: F8, block_reason: U1, scratch: Scalar, placed: Scalar,
) -> None:  # fmt: skip
    number = len(placed.points)
    for first in range(0, number, BLOCK):
        size = min(BLOCK, number - first)
        read_points(source, first, size, planes)
        if moving:
            place_moving(planes, block_reason, offsets, first, size, scratch, True, stamp, path, max_gap_ns, rules)
        else:
            place_still(planes, block_reason, True, posed, pose, rules)
        _write(planes, block_reason, first, size, placed)


def georeference(scan: Scan, trajectory: Trajectory, noise: Noise, limits: Limits | None = None) -> Placed:
    """Place a scan in the map frame (eq. 1).

    Points are rejected for the reasons ``not_finite`` to ``ceiling``; the later reasons are found by the map.
    """
    limits = limits or Limits()
    number = len(scan.points)
    placed = Placed(
        np.empty((number, 3)), np.empty((number, 3, 3)), np.empty(number, np.uint8), np.empty(number),
        np.empty(number), np.empty(number, np.bool_),
    )  # fmt: skip
    path, gap = trajectory.arrays, limits.max_gap_ns
    posed, pose = pose_at(path, gap, scan.stamp_ns)
    _place_blocks(
        source_of(scan.points), scan.times, scan.offsets_ns is not None, scan.stamp_ns, path, gap, posed, pose,
        scan_rules(scan, noise, limits), np.zeros((PLANES, STRIDE)), np.zeros(BLOCK, np.uint8),
        moving_scratch(), placed,
    )  # fmt: skip
    return placed
