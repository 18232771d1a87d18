"""Kernels of eq. 1: transform blocks of points from the sensor's frame to the map's, with covariances and reasons.

All arithmetic is written out in a fixed order: a point gets the same bits in any block.
"""

import math

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, I8, U1, Scalar
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel
from roughmap.points.propagation import point_covariance, rotate, shared_terms
from roughmap.points.rotations import rotation_matrix
from roughmap.points.trajectory import (
    covariance_at,
    find_bracket,
    interpolate,
    pose_pair,
    position_at,
    quaternion_at,
)

BLOCK = 256
"""Points that go through the kernels together; their planes stay in the first-level caches.

Loops always run over the whole block, even for the last points of a scan: a loop of constant length vectorises without
a remainder. The values past the last point are not used.
"""

STEP = 16
"""Runs of points with the same bracket are extended to multiples of this length, for the same reason."""

_NO_BRACKET, _PLACED = -1, -2
"""Values of ``bracket`` for points without a pose and for points already placed."""

STRIDE = BLOCK + 8
"""Distance between the planes of a block, in numbers. With a power of two all planes would share a few cache lines."""

X, Y, Z = 0, 1, 2
_REASON, _BRACKET = 3, 4
_LEVER, _BEAM, _SQUARE = 5, 8, 11
_SINCE, _UNTIL, _FRACTION, _QUAT = 12, 13, 14, 15
S = 19
PLANES = 25
"""Rows of a block's planes (PLANES, STRIDE): position (X to Z); reason and bracket of each point, as floats; both
levers and the squared range; times since the pose before and until the pose after, the fraction between them and the
quaternion there; upper triangle of the covariance (S and five more)."""

_NOT_FINITE = float(PointReason.NOT_FINITE)
_NO_RETURN = float(PointReason.NO_RETURN)
_TIME = float(PointReason.TIME)
_NO_POSE = float(PointReason.NO_POSE)
_SELF = float(PointReason.SELF)
_RANGE = float(PointReason.RANGE)
_CEILING = float(PointReason.CEILING)


@inline
def _first_reason(before: Scalar, x: Scalar, y: Scalar, z: Scalar, outside: Scalar) -> Scalar:
    """Return the first reason that applies; ``before`` is the one found earlier (0, time, no_pose or self).

    ``outside``: the range is out of limits.
    """
    reason = _RANGE if (before == 0.0) & outside else before
    reason = _NO_RETURN if (x == 0.0) & (y == 0.0) & (z == 0.0) else reason
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else _NOT_FINITE


@inline
def _fixed_shape(planes: F8) -> F8:
    """Return the same planes with a constant shape.

    The compiler then proves that the rows do not overlap. Checks at run time cost more than the short loops themselves,
    and beyond 128 checks a loop is not vectorised.
    """
    return carray(pointer(np.uint64(planes.ctypes.data), np.float64(0.0)), (PLANES, STRIDE))


@inline
def _reject_own_body(P: F8, mounting: Scalar, boxes: F8) -> None:
    """Reject the points inside one of the robot's own boxes."""
    for b in range(len(boxes)):
        x0, y0, z0, x1, y1, z1 = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        for n in range(BLOCK):
            v = rotate(mounting, P[X, n], P[Y, n], P[Z, n])
            bx = mounting[9] + v[0]
            by = mounting[10] + v[1]
            bz = mounting[11] + v[2]
            inside = (bx >= x0) & (bx <= x1) & (by >= y0) & (by <= y1) & (bz >= z0) & (bz <= z1)
            P[_REASON, n] = _SELF if inside & (P[_REASON, n] == 0.0) else P[_REASON, n]


@inline
def _place(P: F8, n: Scalar, r: Scalar, t: Scalar, own: Scalar, mounting: Scalar, limits: Scalar) -> None:
    """Place point ``n`` with the pose r, t if it belongs to that pose (``own``); set its levers and its reason."""
    x, y, z, before = P[X, n], P[Y, n], P[Z, n], P[_REASON, n]
    v = rotate(mounting, x, y, z)
    l = rotate(r, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
    m = rotate(r, v[0], v[1], v[2])
    square = x * x + y * y + z * z
    reason = _first_reason(before, x, y, z, (square < limits[0]) | (square > limits[1]))
    px, py, pz = t[0] + l[0], t[1] + l[1], t[2] + l[2]
    P[_REASON, n] = reason if own else before
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
def _reject_above(P: F8, n: Scalar, own: Scalar, limits: Scalar) -> None:
    """Reject point ``n`` if no other reason applies and it is above the ceiling, from the lever that `_place` wrote."""
    x, y, z = P[_BEAM, n], P[_BEAM + 1, n], P[_BEAM + 2, n]
    over = z > limits[2] + limits[3] * math.sqrt(x * x + y * y)
    P[_REASON, n] = _CEILING if over & own & (P[_REASON, n] == 0.0) else P[_REASON, n]


@inline
def _set_covariance(P: F8, n: Scalar, own: Scalar, beam: Scalar, common: Scalar) -> None:
    """Set the covariance of point ``n``, if it belongs to the pose (``own``), from the levers that `_place` wrote."""
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
    """Place one block of points with a single pose (``posed`` False: there is none).

    ``planes`` (PLANES, STRIDE): rows X, Y, Z hold positions in the sensor's frame on entry and in the map frame on
    return; rows from S on receive the upper triangles of the covariances. Both are undefined for rejected points.
    ``reason`` (BLOCK,) is set. ``rules``: see `scan_rules`.
    """
    P = _fixed_shape(planes)
    mounting, beam, mount, limits, boxes = rules
    for n in range(BLOCK):
        P[_REASON, n] = 0.0 if posed else _NO_POSE
    _reject_own_body(P, mounting, boxes)
    t = (pose[9], pose[10], pose[11])
    for n in range(BLOCK):
        _place(P, n, pose, t, True, mounting, limits)
    if limits[2] < math.inf:
        for n in range(BLOCK):
            _reject_above(P, n, True, limits)
    if with_covariance:
        common = shared_terms(pose, mount)
        for n in range(BLOCK):
            _set_covariance(P, n, True, beam, common)
    for n in range(BLOCK):
        reason[n] = np.uint8(P[_REASON, n])


@inline
def _find_brackets(
    P: F8, offsets: I8, first: Scalar, size: Scalar, bracket: I8, stamp: Scalar, stamps: I8, max_gap_ns: Scalar
) -> None:
    """Find the bracket of each point's time: 2 * index of the pose before, + 1 if the time is that pose's own stamp.

    Points without a pose get _NO_BRACKET and a reason.
    """
    for n in range(BLOCK):
        P[_BRACKET, n] = -1.0
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
            P[_REASON, n] = 0.0
            P[_BRACKET, n] = float(bracket[n])
            P[_SINCE, n] = float(t - before)
            P[_UNTIL, n] = float(after - t)
        else:
            bracket[n] = _NO_BRACKET
            P[_REASON, n] = _TIME if off else _NO_POSE


@inline
def _place_run(
    P: F8, which: Scalar, pair: Scalar, low: Scalar, high: Scalar, with_covariance: Scalar, rules: Scalar
) -> None:
    """Place those points from ``low`` to ``high`` whose times lie in bracket ``which``."""
    mounting, beam, mount, limits, _ = rules
    own = float(which)
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            q, u = quaternion_at(pair, P[_SINCE, n], P[_UNTIL, n])
            P[_FRACTION, n] = u
            P[_QUAT, n] = q[0]
            P[_QUAT + 1, n] = q[1]
            P[_QUAT + 2, n] = q[2]
            P[_QUAT + 3, n] = q[3]
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            r = rotation_matrix(P[_QUAT, n], P[_QUAT + 1, n], P[_QUAT + 2, n], P[_QUAT + 3, n])
            _place(P, n, r, position_at(pair, P[_FRACTION, n]), P[_BRACKET, n] == own, mounting, limits)
    if limits[2] < math.inf:
        for n in range(low, high):
            _reject_above(P, n, P[_BRACKET, n] == own, limits)
    if with_covariance:
        for first in range(low, high, STEP):
            for k in range(STEP):
                n = np.uint64(first) + np.uint64(k)
                r = rotation_matrix(P[_QUAT, n], P[_QUAT + 1, n], P[_QUAT + 2, n], P[_QUAT + 3, n])
                pose = (*r, 0.0, 0.0, 0.0, *covariance_at(pair, P[_FRACTION, n]))
                _set_covariance(P, n, P[_BRACKET, n] == own, beam, shared_terms(pose, mount))


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
    path: Scalar,
    max_gap_ns: float,
    rules: Scalar,
) -> None:
    """Place one block of points, each with the pose at its own time ``stamp + offset``; otherwise as `place_still`.

    ``offsets``: those of the whole scan; the block holds ``size`` of them from ``first`` on. Neighbouring points mostly
    lie between the same two poses, so runs of such points are placed by loops without branches.
    """
    P = _fixed_shape(planes)
    _find_brackets(P, offsets, first, size, bracket, stamp, path[0], max_gap_ns)
    _reject_own_body(P, rules[0], rules[4])
    start = 0
    while start < size:
        which = bracket[start]
        stop = start + 1
        while stop < size and bracket[stop] == which:
            stop += 1
        if which >= 0:
            pair = pose_pair(path, which >> 1, which & 1 == 1)
            low, high = start // STEP * STEP, (stop + STEP - 1) // STEP * STEP
            _place_run(P, which, pair, low, high, with_covariance, rules)
            for n in range(start, high):  # also points of this bracket after the run
                bracket[n] = _PLACED if bracket[n] == which else bracket[n]
        elif which == _NO_BRACKET:
            for n in range(start, stop):
                P[_REASON, n] = _first_reason(P[_REASON, n], P[X, n], P[Y, n], P[Z, n], False)
        start = stop
    for n in range(BLOCK):
        reason[n] = np.uint8(P[_REASON, n])


@kernel
def pose_at(
    path: Scalar,
    max_gap_ns: float,
    t: int,
) -> Scalar:
    """Return whether there is a pose at ``t``, and its 33 numbers (those of the first pose if there is none)."""
    low, before, _, linked = find_bracket(path[0], t, max_gap_ns)
    posed = linked or (low >= 0 and t == before)
    pose = interpolate(
        path,
        low if posed else np.int64(0),
        t if posed else path[0][0],
    )
    return posed, pose
