"""Kernels of eq. 1: blocks of points from the sensor's frame into the map's, with covariances and reasons.

Everything is written out in a fixed order, so that a point gets the same bits in whatever block it comes.
"""

import math

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I8, U1, Scalar
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel
from roughmap.points.propagation import point_covariance, spread, turn
from roughmap.points.trajectory import (
    covariance_at,
    find_bracket,
    interpolate,
    pose_pair,
    position_at,
    quaternion_at,
    rotation_matrix,
)

BLOCK = 256
"""Points that go through the kernels together: their planes stay in the nearest caches.

A block is always worked on whole, also the last one of a scan: a loop whose length is known when it is compiled leaves
no remainder to be worked on point by point. What lies past the last point is nobody's.
"""

STEP = 16
"""Runs of points with the same bracket are widened to multiples of this, for the same reason."""

_OUT, _DONE = -1, -2
"""Brackets of points that have no pose, and of those that have been placed."""

STRIDE = BLOCK + 8
"""Numbers from one plane of a block to the next: with a power of two all planes would compete for the same few lines of
the cache."""

X, Y, Z = 0, 1, 2
_WHY, _OWN = 3, 4
_LEVER, _BEAM, _SQUARE = 5, 8, 11
_SINCE, _UNTIL, _ALONG, _TURN = 12, 13, 14, 15
S = 19
PLANES = 25
"""Rows of a block's planes (PLANES, STRIDE): the place (X to Z); the reason and the bracket of each point, as floats;
both levers and the squared range; the times since the pose before and until the one after, the part of the way between
them and the quaternion there; the upper triangle of the covariance (S and five more)."""

_NOT_FINITE = float(PointReason.NOT_FINITE)
_NO_RETURN = float(PointReason.NO_RETURN)
_TIME = float(PointReason.TIME)
_NO_POSE = float(PointReason.NO_POSE)
_SELF = float(PointReason.SELF)
_RANGE = float(PointReason.RANGE)
_CEILING = float(PointReason.CEILING)


@inline
def _judge(before: Scalar, x: Scalar, y: Scalar, z: Scalar, square: Scalar, m: Scalar, limits: Scalar) -> Scalar:
    """The first reason that holds, given what was found ``before`` (0, time, no_pose or self)."""
    r = math.sqrt(square)
    over = m[2] > limits[2] + limits[3] * math.sqrt(m[0] * m[0] + m[1] * m[1])
    outside = (r < limits[0]) | (r > limits[1])
    reason = _CEILING if (before == 0.0) & over else before
    reason = _RANGE if (before == 0.0) & outside else reason
    reason = _NO_RETURN if (x == 0.0) & (y == 0.0) & (z == 0.0) else reason
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else _NOT_FINITE


@inline
def _fixed(planes: F8) -> F8:
    """The same planes, of a shape that the compiler knows.

    It then sees by itself that rows do not overlap; tests of that at run time cost more than short loops do, and past
    128 of them a loop is not vectorised.
    """
    return carray(pointer(np.uint64(planes.ctypes.data), np.float64(0.0)), (PLANES, STRIDE))


@inline
def _exclude(P: F8, mounting: Scalar, boxes: F8) -> None:
    """Mark the points that lie in one of the robot's own boxes."""
    for b in range(len(boxes)):
        x0, y0, z0, x1, y1, z1 = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        for n in range(BLOCK):
            v = turn(mounting, P[X, n], P[Y, n], P[Z, n])
            bx = mounting[9] + v[0]
            by = mounting[10] + v[1]
            bz = mounting[11] + v[2]
            inside = (bx >= x0) & (bx <= x1) & (by >= y0) & (by <= y1) & (bz >= z0) & (bz <= z1)
            P[_WHY, n] = _SELF if inside & (P[_WHY, n] == 0.0) else P[_WHY, n]


@inline
def _place(P: F8, n: Scalar, r: Scalar, t: Scalar, own: Scalar, mounting: Scalar, limits: Scalar) -> None:
    """Place point ``n`` with the pose r, t if it is that one's ``own``; its levers and what it is rejected for."""
    x, y, z, before = P[X, n], P[Y, n], P[Z, n], P[_WHY, n]
    v = turn(mounting, x, y, z)
    l = turn(r, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
    m = turn(r, v[0], v[1], v[2])
    square = x * x + y * y + z * z
    why = _judge(before, x, y, z, square, m, limits)
    px, py, pz = t[0] + l[0], t[1] + l[1], t[2] + l[2]
    P[_WHY, n] = why if own else before
    P[X, n] = px if own else x
    P[Y, n] = py if own else y
    P[Z, n] = pz if own else z
    P[_LEVER, n] = l[0]
    P[_LEVER + 1, n] = l[1]
    P[_LEVER + 2, n] = l[2]
    P[_BEAM, n] = m[0]
    P[_BEAM + 1, n] = m[1]
    P[_BEAM + 2, n] = m[2]
    P[_SQUARE, n] = square


@inline
def _cover(P: F8, n: Scalar, own: Scalar, beam: Scalar, common: Scalar) -> None:
    """The covariance of point ``n``, if it is the pose's ``own``, from the levers that `_place` left."""
    l = (P[_LEVER, n], P[_LEVER + 1, n], P[_LEVER + 2, n])  # noqa: E741
    m = (P[_BEAM, n], P[_BEAM + 1, n], P[_BEAM + 2, n])
    s = point_covariance(l, m, P[_SQUARE, n], beam, common)
    o = (P[S, n], P[S + 1, n], P[S + 2, n], P[S + 3, n], P[S + 4, n], P[S + 5, n])
    P[S, n] = s[0] if own else o[0]
    P[S + 1, n] = s[1] if own else o[1]
    P[S + 2, n] = s[2] if own else o[2]
    P[S + 3, n] = s[3] if own else o[3]
    P[S + 4, n] = s[4] if own else o[4]
    P[S + 5, n] = s[5] if own else o[5]


@inline
def place_still(planes: F8, reason: U1, with_covariance: bool, posed: bool, pose: Scalar, rules: Scalar) -> None:
    """One block of points, all placed with one pose (or none: ``posed`` False).

    ``planes`` (PLANES, STRIDE): rows X, Y, Z hold places in the sensor's frame, and then in the map's; rows from S on
    the upper triangles of their covariances; of rejected points they say nothing. ``reason`` (BLOCK,) is set.
    ``rules``: what `point_rules` gives.
    """
    P = _fixed(planes)
    mounting, beam, mount, limits, boxes = rules
    for n in range(BLOCK):
        P[_WHY, n] = 0.0 if posed else _NO_POSE
    _exclude(P, mounting, boxes)
    t = (pose[9], pose[10], pose[11])
    for n in range(BLOCK):
        _place(P, n, pose, t, True, mounting, limits)
    if with_covariance:
        common = spread(pose, mount)
        for n in range(BLOCK):
            _cover(P, n, True, beam, common)
    for n in range(BLOCK):
        reason[n] = np.uint8(P[_WHY, n])


@inline
def _find_pairs(
    P: F8, offsets: I8, first: Scalar, size: Scalar, bracket: I8, stamp: Scalar, stamps: I8, max_gap_ns: Scalar
) -> None:
    """The bracket of each point's own time: 2 * index, + 1 if it is that pose's own stamp, or _OUT with a reason."""
    for n in range(BLOCK):
        P[_OWN, n] = -1.0
        P[_SINCE, n] = 0.0
        P[_UNTIL, n] = 0.0
    low, before, after, linked = find_bracket(stamps, stamp, max_gap_ns)
    for n in range(size):
        offset = offsets[first + n]
        t = stamp + offset
        if t < before or t >= after:
            low, before, after, linked = find_bracket(stamps, t, max_gap_ns)
        off = (offset < 0) | (offset > OFFSET_LIMIT_NS) | (t >= STAMP_LIMIT_NS)
        exact = t == before
        if (linked or exact) and not off:
            bracket[n] = 2 * low + (np.int64(1) if exact else np.int64(0))
            P[_WHY, n] = 0.0
            P[_OWN, n] = float(bracket[n])
            P[_SINCE, n] = float(t - before)
            P[_UNTIL, n] = float(after - t)
        else:
            bracket[n] = _OUT
            P[_WHY, n] = _TIME if off else _NO_POSE


@inline
def _place_run(
    P: F8, which: Scalar, pair: Scalar, low: Scalar, high: Scalar, with_covariance: Scalar, rules: Scalar
) -> None:
    """Place the points whose times lie in bracket ``which``; they are among those from ``low`` to ``high``."""
    mounting, beam, mount, limits, _ = rules
    own = float(which)
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            q, u = quaternion_at(pair, P[_SINCE, n], P[_UNTIL, n])
            P[_ALONG, n] = u
            P[_TURN, n] = q[0]
            P[_TURN + 1, n] = q[1]
            P[_TURN + 2, n] = q[2]
            P[_TURN + 3, n] = q[3]
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            r = rotation_matrix(P[_TURN, n], P[_TURN + 1, n], P[_TURN + 2, n], P[_TURN + 3, n])
            _place(P, n, r, position_at(pair, P[_ALONG, n]), P[_OWN, n] == own, mounting, limits)
    if with_covariance:
        for first in range(low, high, STEP):
            for k in range(STEP):
                n = np.uint64(first) + np.uint64(k)
                r = rotation_matrix(P[_TURN, n], P[_TURN + 1, n], P[_TURN + 2, n], P[_TURN + 3, n])
                pose = (*r, 0.0, 0.0, 0.0, *covariance_at(pair, P[_ALONG, n]))
                _cover(P, n, P[_OWN, n] == own, beam, spread(pose, mount))


@inline
def place_moving(
    planes: F8,
    reason: U1,
    offsets: I8,
    first: int,
    size: int,
    bracket: I8,
    with_covariance: bool,
    stamp: int,
    way: Scalar,
    max_gap_ns: float,
    rules: Scalar,
) -> None:
    """One block of points, each placed with the pose at its own time ``stamp + offset``. Otherwise `place_still`.

    ``offsets`` are those of the scan, of which the block holds ``size`` from ``first`` on. Neighbours mostly lie
    between the same two poses: run after run of such is worked on by loops without a branch.
    """
    P = _fixed(planes)
    mounting, _, _, limits, boxes = rules
    _find_pairs(P, offsets, first, size, bracket, stamp, way[0], max_gap_ns)
    _exclude(P, mounting, boxes)
    start = 0
    while start < size:
        which = bracket[start]
        stop = start + 1
        while stop < size and bracket[stop] == which:
            stop += 1
        if which >= 0:
            pair = pose_pair(way, which >> 1, which & 1 == 1)
            low, high = start // STEP * STEP, (stop + STEP - 1) // STEP * STEP
            _place_run(P, which, pair, low, high, with_covariance, rules)
            for n in range(start, high):  # also those that came in between others
                bracket[n] = _DONE if bracket[n] == which else bracket[n]
        elif which == _OUT:
            for n in range(start, stop):
                x, y, z = P[X, n], P[Y, n], P[Z, n]
                v = turn(mounting, x, y, z)
                P[_WHY, n] = _judge(P[_WHY, n], x, y, z, x * x + y * y + z * z, v, limits)
        start = stop
    for n in range(BLOCK):
        reason[n] = np.uint8(P[_WHY, n])


@kernel
def pose_at(
    way: Scalar,
    max_gap_ns: float,
    t: int,
) -> Scalar:
    """Whether there is a pose at ``t``, and its 33 numbers (those of the first pose where there is none)."""
    low, before, _, linked = find_bracket(way[0], t, max_gap_ns)
    posed = linked or (low >= 0 and t == before)
    pose = interpolate(
        way,
        low if posed else np.int64(0),
        t if posed else way[0][0],
    )
    return posed, pose
