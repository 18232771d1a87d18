"""From the sensor into the map (eq. 1)."""

import numpy as np

from roughmap.arrays import F8, U1
from roughmap.jit import kernel
from roughmap.place import BLOCK, LEVERS, place_moving, place_still, pose_at, split
from roughmap.scan import Limits, Noise, Scan, point_rules
from roughmap.trajectory import Trajectory

__all__ = ["Limits", "Noise", "Scan", "georeference"]


@kernel
def _fill(x: F8, y: F8, z: F8, reason: U1, S: F8, start: int, points: F8, covariance: F8) -> None:
    for n in range(len(x)):
        kept = reason[n] == 0
        points[start + n, 0] = x[n] if kept else np.nan
        points[start + n, 1] = y[n] if kept else np.nan
        points[start + n, 2] = z[n] if kept else np.nan
        c = covariance[start + n]
        c[0, 0] = S[0, n] if kept else np.nan
        c[0, 1] = S[1, n] if kept else np.nan
        c[0, 2] = S[2, n] if kept else np.nan
        c[1, 1] = S[3, n] if kept else np.nan
        c[1, 2] = S[4, n] if kept else np.nan
        c[2, 2] = S[5, n] if kept else np.nan
        c[1, 0] = c[0, 1]
        c[2, 0] = c[0, 2]
        c[2, 1] = c[1, 2]


def georeference(scan: Scan, trajectory: Trajectory, noise: Noise, limits: Limits | None = None) -> tuple[F8, F8, U1]:
    """Place a scan in the map frame (eq. 1).

    Returns points (N, 3), covariances (N, 3, 3) and reasons (N,) of `PointReason`, 0 = kept; rejected rows are NaN.
    Rejects for the reasons ``not_finite`` to ``ceiling``; the later ones are the map's.
    """
    limits = limits or Limits()
    number = len(scan.points)
    x, y, z = np.empty(number), np.empty(number), np.empty(number)
    reason = np.zeros(number, np.uint8)
    points, covariance = np.empty((number, 3)), np.empty((number, 3, 3))
    levers, S, bracket = np.empty((LEVERS, BLOCK)), np.empty((6, BLOCK)), np.empty(BLOCK, np.int64)
    split(scan.points, 0, number, x, y, z)
    way, gap = trajectory.arrays, limits.max_gap_ns
    rules = point_rules(scan, noise, limits)
    posed, pose = pose_at(way, gap, scan.stamp_ns)
    for start in range(0, number, BLOCK):
        part = slice(start, min(start + BLOCK, number))
        planes = (x[part], y[part], z[part], reason[part])
        if scan.offsets_ns is None:
            place_still(*planes, levers, S, True, posed, pose, rules)
        else:
            place_moving(*planes, scan.offsets_ns[part], bracket, levers, S, True, scan.stamp_ns, way, gap, rules)
        _fill(*planes, S, start, points, covariance)
    return points, covariance, reason
