"""Kernels of eq. 1: transform blocks of points from the sensor's frame to the map's, with covariances and reasons.

All arithmetic is written out in a fixed order: a point gets the same bits in any block.
"""

import math

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import F8, U1, Scalar
from roughmap.cell import PointReason
from roughmap.intrinsics import pointer
from roughmap.jit import inline, kernel
from roughmap.points.propagation import height_variances, point_covariance, rotate, shared_terms
from roughmap.points.trajectory import find_bracket, interpolate

BLOCK = 256
"""Points that go through the kernels together; their planes stay in the first-level caches.

Loops always run over the whole block, even for the last points of a scan: a loop of constant length vectorises without
a remainder. The values past the last point are not used.
"""

STRIDE = BLOCK + 8
"""Distance between the planes of a block, in numbers. With a power of two all planes would share a few cache lines."""

X, Y, Z = 0, 1, 2
REASON, BRACKET = 3, 4
_LEVER, _BEAM, _SQUARE = 5, 8, 11
SINCE, UNTIL, FRACTION, QUAT = 12, 13, 14, 15
S = 19
COMMON, MOUNT, UP = 25, 26, 27
PLANES = 28
"""Rows of a block's planes (PLANES, STRIDE): position (X to Z); reason and bracket of each point, as floats; both
levers and the squared range; times since the pose before and until the pose after, the fraction between them and the
quaternion there; upper triangle of the covariance (S and five more); variances of the height from the pose and from
the mounting; 1 for a point that looks up."""

_STEEPEST = 0.546
"""tan 0.5 rad. Seen from the sensor, no ground of at most this slope rises more steeply."""

_NOT_FINITE = float(PointReason.NOT_FINITE)
_NO_RETURN = float(PointReason.NO_RETURN)
_NO_POSE = float(PointReason.NO_POSE)
_SELF = float(PointReason.SELF)
_RANGE = float(PointReason.RANGE)
_CEILING = float(PointReason.CEILING)


@inline
def first_reason(before: Scalar, x: Scalar, y: Scalar, z: Scalar, outside: Scalar) -> Scalar:
    """Return the first reason that applies; ``before`` is the one found earlier (0, time, no_pose or self).

    ``outside``: the range is out of limits.
    """
    reason = _RANGE if (before == 0.0) & outside else before
    reason = _NO_RETURN if (x == 0.0) & (y == 0.0) & (z == 0.0) else reason
    finite = (abs(x) < math.inf) & (abs(y) < math.inf) & (abs(z) < math.inf)
    return reason if finite else _NOT_FINITE


@inline
def fixed_shape(planes: F8) -> F8:
    """Return the same planes with a constant shape.

    The compiler then proves that the rows do not overlap. Checks at run time cost more than the short loops themselves,
    and beyond 128 checks a loop is not vectorised.
    """
    return carray(pointer(np.uint64(planes.ctypes.data), np.float64(0.0)), (PLANES, STRIDE))


@inline
def reject_own_body(P: F8, mounting: Scalar, boxes: F8) -> None:
    """Reject the points inside one of the robot's own boxes."""
    for b in range(len(boxes)):
        x0, y0, z0, x1, y1, z1 = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        for n in range(BLOCK):
            v = rotate(mounting, P[X, n], P[Y, n], P[Z, n])
            bx = mounting[9] + v[0]
            by = mounting[10] + v[1]
            bz = mounting[11] + v[2]
            inside = (bx >= x0) & (bx <= x1) & (by >= y0) & (by <= y1) & (bz >= z0) & (bz <= z1)
            P[REASON, n] = _SELF if inside & (P[REASON, n] == 0.0) else P[REASON, n]


@inline
def place(P: F8, n: Scalar, r: Scalar, t: Scalar, own: Scalar, mounting: Scalar, limits: Scalar) -> None:
    """Place point ``n`` with the pose r, t if it belongs to that pose (``own``); set its levers and its reason."""
    x, y, z, before = P[X, n], P[Y, n], P[Z, n], P[REASON, n]
    v = rotate(mounting, x, y, z)
    l = rotate(r, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
    m = rotate(r, v[0], v[1], v[2])
    square = x * x + y * y + z * z
    reason = first_reason(before, x, y, z, (square < limits[0]) | (square > limits[1]))
    px, py, pz = t[0] + l[0], t[1] + l[1], t[2] + l[2]
    P[REASON, n] = reason if own else before
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
    up = 1.0 if m[2] > _STEEPEST * math.sqrt(m[0] * m[0] + m[1] * m[1]) else 0.0
    P[UP, n] = up if own else P[UP, n]


@inline
def reject_above(P: F8, n: Scalar, own: Scalar, limits: Scalar) -> None:
    """Reject point ``n`` if no other reason applies and it is above the ceiling, from the lever that `place` wrote."""
    x, y, z = P[_BEAM, n], P[_BEAM + 1, n], P[_BEAM + 2, n]
    over = z > limits[2] + limits[3] * math.sqrt(x * x + y * y)
    P[REASON, n] = _CEILING if over & own & (P[REASON, n] == 0.0) else P[REASON, n]


@inline
def set_heights(P: F8, n: Scalar, own: Scalar, common: Scalar, mounted: Scalar) -> None:
    """Set the variances of the height of point ``n`` from its pose and its mounting alone; otherwise as
    `set_covariance`."""
    l = (P[_LEVER, n], P[_LEVER + 1, n], P[_LEVER + 2, n])  # noqa: E741
    m = (P[_BEAM, n], P[_BEAM + 1, n], P[_BEAM + 2, n])
    pose, mount = height_variances(l, m, common, mounted)
    P[COMMON, n] = pose if own else P[COMMON, n]
    P[MOUNT, n] = mount if own else P[MOUNT, n]


@inline
def set_covariance(P: F8, n: Scalar, own: Scalar, beam: Scalar, common: Scalar, mounted: Scalar) -> None:
    """Set the covariance of point ``n`` and its parts, if it belongs to the pose (``own``), from the levers that
    `place` wrote.

    ``common``, ``mounted``: see `shared_terms`.
    """
    set_heights(P, n, own, common, mounted)
    l = (P[_LEVER, n], P[_LEVER + 1, n], P[_LEVER + 2, n])  # noqa: E741
    m = (P[_BEAM, n], P[_BEAM + 1, n], P[_BEAM + 2, n])
    s = point_covariance(l, m, P[_SQUARE, n], beam, common, mounted)
    o = (P[S, n], P[S + 1, n], P[S + 2, n], P[S + 3, n], P[S + 4, n], P[S + 5, n])
    P[S, n] = s[0] if own else o[0]
    P[S + 1, n] = s[1] if own else o[1]
    P[S + 2, n] = s[2] if own else o[2]
    P[S + 3, n] = s[3] if own else o[3]
    P[S + 4, n] = s[4] if own else o[4]
    P[S + 5, n] = s[5] if own else o[5]


@inline
def is_uncertain(mount: Scalar) -> Scalar:
    """Whether any variance of the mounting is above zero."""
    return max(mount[0], mount[1], mount[2], mount[3], mount[4], mount[5]) > 0.0


@inline
def _set_still(P: F8, beam: Scalar, common: Scalar, mounted: Scalar, with_covariance: Scalar) -> None:
    if with_covariance:
        for n in range(BLOCK):
            set_covariance(P, n, True, beam, common, mounted)
    else:
        for n in range(BLOCK):
            set_heights(P, n, True, common, mounted)


@inline
def place_still(planes: F8, reason: U1, with_covariance: bool, posed: bool, pose: Scalar, rules: Scalar) -> None:
    """Place one block of points with a single pose (``posed`` False: there is none).

    ``planes`` (PLANES, STRIDE): rows X, Y, Z hold positions in the sensor's frame on entry and in the map frame on
    return; rows from S on receive the upper triangles of the covariances (if ``with_covariance``), COMMON and MOUNT
    their parts in the height, UP whether the point looks up. All are undefined for rejected points. ``reason``
    (BLOCK,) is set. ``rules``: see `scan_rules`.
    """
    P = fixed_shape(planes)
    mounting, beam, mount, limits, boxes = rules
    for n in range(BLOCK):
        P[REASON, n] = 0.0 if posed else _NO_POSE
    reject_own_body(P, mounting, boxes)
    t = (pose[9], pose[10], pose[11])
    for n in range(BLOCK):
        place(P, n, pose, t, True, mounting, limits)
    if limits[2] < math.inf:
        for n in range(BLOCK):
            reject_above(P, n, True, limits)
    if is_uncertain(mount):
        _set_still(P, beam, shared_terms(pose, mount, True), True, with_covariance)
    else:
        _set_still(P, beam, shared_terms(pose, mount, False), False, with_covariance)
    for n in range(BLOCK):
        reason[n] = np.uint8(P[REASON, n])


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
