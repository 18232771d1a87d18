"""Kernels of eq. 1: blocks of points from the sensor's frame into the map's, with covariances and reasons.

Everything is written out in a fixed order, so that a point gets the same bits in whatever block it comes.
"""

import math

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, U1, Scalar
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.jit import inline, kernel
from roughmap.propagation import point_covariance, spread, turn
from roughmap.trajectory import (
    covariance_at,
    find_bracket,
    interpolate,
    pose_pair,
    position_at,
    quaternion_at,
    rotation_matrix,
)

BLOCK = 256
"""Points that go through the kernels together: their planes stay in the first-level cache."""

LEVERS = 12
"""Planes of a block between its places and its covariances: both levers, the squared range, and, where each point has
a time of its own, the part of the way between two poses and the quaternion. Few,
and filled in three loops: past 128 pairs of planes that may overlap LLVM gives up vectorising a loop."""

_NOT_FINITE = int(PointReason.NOT_FINITE)
_NO_RETURN = int(PointReason.NO_RETURN)
_TIME = int(PointReason.TIME)
_NO_POSE = int(PointReason.NO_POSE)
_SELF = int(PointReason.SELF)
_RANGE = int(PointReason.RANGE)
_CEILING = int(PointReason.CEILING)


@inline
def _judge(before: Scalar, x: Scalar, y: Scalar, z: Scalar, square: Scalar, m: Scalar, limits: Scalar) -> Scalar:
    """The first reason that holds, given what was found ``before`` (0, time, no_pose or self)."""
    r = math.sqrt(square)
    reason = before
    over = m[2] > limits[2] + limits[3] * math.sqrt(m[0] * m[0] + m[1] * m[1])
    outside = (r < limits[0]) | (r > limits[1])
    reason = np.uint8(_CEILING) if (reason == 0) & over else reason
    reason = np.uint8(_RANGE) if ((before == 0) & outside) else reason
    reason = np.uint8(_NO_RETURN) if (x == 0.0) & (y == 0.0) & (z == 0.0) else reason
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else np.uint8(_NOT_FINITE)


@kernel
def split(points: npt.NDArray[np.floating], start: int, stop: int, x: F8, y: F8, z: F8) -> None:
    """Points (N, 3) into float64 planes."""
    for n in range(start, stop):
        x[n] = points[n, 0]
        y[n] = points[n, 1]
        z[n] = points[n, 2]


@inline
def _exclude(x: F8, y: F8, z: F8, reason: U1, mounting: Scalar, boxes: F8) -> None:
    """Mark the points that lie in one of the robot's own boxes."""
    for b in range(len(boxes)):
        x0, y0, z0, x1, y1, z1 = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        for n in range(len(x)):
            v = turn(mounting, x[n], y[n], z[n])
            bx = mounting[9] + v[0]
            by = mounting[10] + v[1]
            bz = mounting[11] + v[2]
            inside = (bx >= x0) & (bx <= x1) & (by >= y0) & (by <= y1) & (bz >= z0) & (bz <= z1)
            reason[n] = np.uint8(_SELF) if inside & (reason[n] == 0) else reason[n]


@kernel
def place_still(
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    levers: F8,
    S: F8,
    with_covariance: bool,
    posed: bool,
    pose: Scalar,
    rules: Scalar,
) -> None:
    """One block of points, all placed with one pose (or none: ``posed`` False).

    ``x``, ``y``, ``z``: in the sensor's frame, turned into the map's in place; of rejected points they say nothing.
    ``reason`` is set. ``S`` (6, BLOCK): upper triangles of the covariances. ``levers`` (LEVERS, BLOCK) is scratch.
    ``rules``: what `point_rules` gives.
    """
    mounting, beam, mount, limits, boxes = rules
    size = len(x)
    for n in range(size):
        reason[n] = 0 if posed else np.uint8(_NO_POSE)
    _exclude(x, y, z, reason, mounting, boxes)
    for n in range(size):
        px, py, pz = x[n], y[n], z[n]
        v = turn(mounting, px, py, pz)
        l = turn(pose, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
        m = turn(pose, v[0], v[1], v[2])
        square = px * px + py * py + pz * pz
        reason[n] = _judge(reason[n], px, py, pz, square, m, limits)
        x[n] = pose[9] + l[0]
        y[n] = pose[10] + l[1]
        z[n] = pose[11] + l[2]
        levers[0, n] = l[0]
        levers[1, n] = l[1]
        levers[2, n] = l[2]
        levers[3, n] = m[0]
        levers[4, n] = m[1]
        levers[5, n] = m[2]
        levers[6, n] = square
    if with_covariance:
        common = spread(pose, mount)
        for n in range(size):
            l = (levers[0, n], levers[1, n], levers[2, n])  # noqa: E741
            m = (levers[3, n], levers[4, n], levers[5, n])
            s = point_covariance(l, m, levers[6, n], beam, common)
            S[0, n] = s[0]
            S[1, n] = s[1]
            S[2, n] = s[2]
            S[3, n] = s[3]
            S[4, n] = s[4]
            S[5, n] = s[5]


@inline
def _find_pairs(offsets: I8, bracket: I8, reason: U1, stamp: Scalar, stamps: I8, max_gap_ns: Scalar) -> None:
    """The bracket of each point's own time: 2 * index, + 1 if it is that pose's own stamp, or -1 with a reason."""
    hint = np.int64(-1)
    for n in range(len(offsets)):
        off = (offsets[n] < 0) | (offsets[n] > OFFSET_LIMIT_NS) | (stamp + offsets[n] >= STAMP_LIMIT_NS)
        bracket[n] = -1
        if off:
            reason[n] = _TIME
        else:
            found = find_bracket(stamps, stamp + offsets[n], hint, max_gap_ns)
            hint = found if found >= 0 else hint
            reason[n] = 0 if found >= 0 else np.uint8(_NO_POSE)
            if found >= 0:
                bracket[n] = 2 * found + (np.int64(1) if stamps[found] == stamp + offsets[n] else np.int64(0))


@inline
def _turn_run(pair: Scalar, offsets: I8, levers: F8, stamp: Scalar) -> None:
    """Rotations of points whose times lie in one bracket; rows 7-11 of ``levers``."""
    for n in range(len(offsets)):
        q, u = quaternion_at(pair, stamp + offsets[n])
        levers[7, n] = u
        levers[8, n] = q[0]
        levers[9, n] = q[1]
        levers[10, n] = q[2]
        levers[11, n] = q[3]


@inline
def _place_run(pair: Scalar, x: F8, y: F8, z: F8, reason: U1, levers: F8, rules: Scalar) -> None:
    """Positions and reasons of points that `_turn_run` has turned; rows 0-6 of ``levers``."""
    mounting, _, _, limits, _ = rules
    for n in range(len(x)):
        px, py, pz = x[n], y[n], z[n]
        v = turn(mounting, px, py, pz)
        r = rotation_matrix(levers[8, n], levers[9, n], levers[10, n], levers[11, n])
        l = turn(r, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
        m = turn(r, v[0], v[1], v[2])
        square = px * px + py * py + pz * pz
        reason[n] = _judge(reason[n], px, py, pz, square, m, limits)
        p = position_at(pair, levers[7, n])
        x[n] = p[0] + l[0]
        y[n] = p[1] + l[1]
        z[n] = p[2] + l[2]
        levers[0, n] = l[0]
        levers[1, n] = l[1]
        levers[2, n] = l[2]
        levers[3, n] = m[0]
        levers[4, n] = m[1]
        levers[5, n] = m[2]
        levers[6, n] = square


@inline
def _spread_run(pair: Scalar, levers: F8, S: F8, first: Scalar, size: Scalar, rules: Scalar) -> None:
    """The covariances, from column ``first`` on, of a run of ``size`` points that `_place_run` has placed."""
    _, beam, mount, _, _ = rules
    for n in range(size):
        l = (levers[0, n], levers[1, n], levers[2, n])  # noqa: E741
        m = (levers[3, n], levers[4, n], levers[5, n])
        r = rotation_matrix(levers[8, n], levers[9, n], levers[10, n], levers[11, n])
        pose = (*r, 0.0, 0.0, 0.0, *covariance_at(pair, levers[7, n]))
        s = point_covariance(l, m, levers[6, n], beam, spread(pose, mount))
        # Unsigned: a signed index is tested for being negative, and the loop no longer vectorised.
        k = np.uint64(first) + np.uint64(n)
        S[0, k] = s[0]
        S[1, k] = s[1]
        S[2, k] = s[2]
        S[3, k] = s[3]
        S[4, k] = s[4]
        S[5, k] = s[5]


@kernel
def place_moving(
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    offsets: I8,
    bracket: I8,
    levers: F8,
    S: F8,
    with_covariance: bool,
    stamp: int,
    way: Scalar,
    max_gap_ns: float,
    rules: Scalar,
) -> None:
    """One block of points, each placed with the pose at its own time ``stamp + offset``. Otherwise `place_still`.

    Neighbours mostly lie between the same two poses: run after run of such is worked on by loops without a branch.
    """
    mounting, _, _, limits, boxes = rules
    size = len(x)
    _find_pairs(offsets, bracket, reason, stamp, way[0], max_gap_ns)
    _exclude(x, y, z, reason, mounting, boxes)
    first = 0
    while first < size:
        which = bracket[first]
        stop = first + 1
        while stop < size and bracket[stop] == which:
            stop += 1
        if which >= 0:
            pair = pose_pair(way, which >> 1, which & 1 == 1)
            part = slice(first, stop)
            _turn_run(pair, offsets[part], levers, stamp)
            _place_run(pair, x[part], y[part], z[part], reason[part], levers, rules)
            if with_covariance:
                _spread_run(pair, levers, S, first, stop - first, rules)
        else:
            for n in range(first, stop):
                px, py, pz = x[n], y[n], z[n]
                v = turn(mounting, px, py, pz)
                reason[n] = _judge(reason[n], px, py, pz, px * px + py * py + pz * pz, v, limits)
        first = stop


@kernel
def pose_at(
    way: Scalar,
    max_gap_ns: float,
    t: int,
) -> Scalar:
    """Whether there is a pose at ``t``, and its 33 numbers (those of the first pose where there is none)."""
    low = find_bracket(way[0], t, np.int64(-1), max_gap_ns)
    posed = low >= 0
    pose = interpolate(
        way,
        low if posed else np.int64(0),
        t if posed else way[0][0],
    )
    return posed, pose
