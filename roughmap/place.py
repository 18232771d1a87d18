"""Kernels of eq. 1: blocks of points from the sensor's frame into the map's, with covariances and reasons.

Everything is written out in a fixed order, so that a point gets the same bits in whatever block it comes.
"""

import math

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, U1, Scalar
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.jit import inline, kernel
from roughmap.trajectory import find_bracket, interpolate

BLOCK = 256
"""Points that go through the kernels together: their planes stay in the first-level cache."""

_NOT_FINITE = int(PointReason.NOT_FINITE)
_NO_RETURN = int(PointReason.NO_RETURN)
_TIME = int(PointReason.TIME)
_NO_POSE = int(PointReason.NO_POSE)
_SELF = int(PointReason.SELF)
_RANGE = int(PointReason.RANGE)
_CEILING = int(PointReason.CEILING)


@inline
def _turn(m: Scalar, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """The 3x3 matrix in the first nine numbers of ``m``, times a vector."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


@inline
def _turned_diagonal(r: Scalar, a: Scalar, b: Scalar, c: Scalar) -> Scalar:
    """Upper triangle of R diag(a, b, c) R^T."""
    return (
        r[0] * r[0] * a + r[1] * r[1] * b + r[2] * r[2] * c,
        r[0] * r[3] * a + r[1] * r[4] * b + r[2] * r[5] * c,
        r[0] * r[6] * a + r[1] * r[7] * b + r[2] * r[8] * c,
        r[3] * r[3] * a + r[4] * r[4] * b + r[5] * r[5] * c,
        r[3] * r[6] * a + r[4] * r[7] * b + r[5] * r[8] * c,
        r[6] * r[6] * a + r[7] * r[7] * b + r[8] * r[8] * c,
    )


@inline
def _spread(pose: Scalar, mount: Scalar) -> Scalar:
    """What of the covariance is the same for all points of a pose, 27 numbers.

    A (6, upper): translation block of S_pose + of S_mount turned into map axes; B (9): translation-rotation block of
    S_pose; C (6): its rotation block; D (6): rotation block of S_mount in map axes.
    """
    shift = _turned_diagonal(pose, mount[0], mount[1], mount[2])
    tilt = _turned_diagonal(pose, mount[3], mount[4], mount[5])
    return (
        pose[12] + shift[0],
        pose[13] + shift[1],
        pose[14] + shift[2],
        pose[18] + shift[3],
        pose[19] + shift[4],
        pose[23] + shift[5],
        pose[15],
        pose[16],
        pose[17],
        pose[20],
        pose[21],
        pose[22],
        pose[24],
        pose[25],
        pose[26],
        pose[27],
        pose[28],
        pose[29],
        pose[30],
        pose[31],
        pose[32],
        tilt[0],
        tilt[1],
        tilt[2],
        tilt[3],
        tilt[4],
        tilt[5],
    )


@inline
def _lever_square(c0: Scalar, c1: Scalar, c2: Scalar, c3: Scalar, c4: Scalar, c5: Scalar, l: Scalar) -> Scalar:  # noqa: E741
    """Upper triangle of K C K^T with K = -[l]x and C given by its upper triangle."""
    x, y, z = l
    # D = C K^T, row by row; K^T has the columns (0, lz, -ly), (-lz, 0, lx), (ly, -lx, 0).
    d01 = c2 * x - c0 * z
    d02 = c0 * y - c1 * x
    d10 = c3 * z - c4 * y
    d11 = c4 * x - c1 * z
    d12 = c1 * y - c3 * x
    d20 = c4 * z - c5 * y
    d21 = c5 * x - c2 * z
    d22 = c2 * y - c4 * x
    return (
        z * d10 - y * d20,
        z * d11 - y * d21,
        z * d12 - y * d22,
        x * d21 - z * d01,
        x * d22 - z * d02,
        y * d02 - x * d12,
    )


@inline
def _covariance(l: Scalar, m: Scalar, square: Scalar, beam: Scalar, s: Scalar) -> Scalar:  # noqa: E741
    """Upper triangle of S (eq. 1) from the levers l and l_m, the squared range, and the pose's `_spread`."""
    sr = beam[0] + beam[1] * math.sqrt(square)
    across = beam[2] * beam[2] * square
    along = (sr * sr - across) / square
    x, y, z = l
    pose = _lever_square(s[15], s[16], s[17], s[18], s[19], s[20], l)
    mount = _lever_square(s[21], s[22], s[23], s[24], s[25], s[26], m)
    # B K^T: row i is (b1 z - b2 y, b2 x - b0 z, b0 y - b1 x); S takes it and its transpose.
    b00 = s[7] * z - s[8] * y
    b01 = s[8] * x - s[6] * z
    b02 = s[6] * y - s[7] * x
    b10 = s[10] * z - s[11] * y
    b11 = s[11] * x - s[9] * z
    b12 = s[9] * y - s[10] * x
    b20 = s[13] * z - s[14] * y
    b21 = s[14] * x - s[12] * z
    b22 = s[12] * y - s[13] * x
    return (
        across + along * m[0] * m[0] + s[0] + (b00 + b00) + pose[0] + mount[0],
        along * m[0] * m[1] + s[1] + (b01 + b10) + pose[1] + mount[1],
        along * m[0] * m[2] + s[2] + (b02 + b20) + pose[2] + mount[2],
        across + along * m[1] * m[1] + s[3] + (b11 + b11) + pose[3] + mount[3],
        along * m[1] * m[2] + s[4] + (b12 + b21) + pose[4] + mount[4],
        across + along * m[2] * m[2] + s[5] + (b22 + b22) + pose[5] + mount[5],
    )


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
            v = _turn(mounting, x[n], y[n], z[n])
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
    ``reason`` is set. ``S`` (6, BLOCK): upper triangles of the covariances. ``levers`` (7, BLOCK) is scratch.
    ``rules``: what `point_rules` gives.
    """
    mounting, beam, mount, limits, boxes = rules
    size = len(x)
    for n in range(size):
        reason[n] = 0 if posed else np.uint8(_NO_POSE)
    _exclude(x, y, z, reason, mounting, boxes)
    for n in range(size):
        px, py, pz = x[n], y[n], z[n]
        v = _turn(mounting, px, py, pz)
        l = _turn(pose, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
        m = _turn(pose, v[0], v[1], v[2])
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
        spread = _spread(pose, mount)
        for n in range(size):
            l = (levers[0, n], levers[1, n], levers[2, n])  # noqa: E741
            m = (levers[3, n], levers[4, n], levers[5, n])
            s = _covariance(l, m, levers[6, n], beam, spread)
            S[0, n] = s[0]
            S[1, n] = s[1]
            S[2, n] = s[2]
            S[3, n] = s[3]
            S[4, n] = s[4]
            S[5, n] = s[5]


@kernel
def place_moving(
    x: F8,
    y: F8,
    z: F8,
    reason: U1,
    offsets: I8,
    bracket: I8,
    S: F8,
    with_covariance: bool,
    stamp: int,
    way: Scalar,
    max_gap_ns: float,
    rules: Scalar,
) -> None:
    """One block of points, each placed with the pose at its own time ``stamp + offset``. Otherwise `place_still`."""
    mounting, beam, mount, limits, boxes = rules
    size = len(x)
    hint = np.int64(-1)
    for n in range(size):
        off = (offsets[n] < 0) | (offsets[n] > OFFSET_LIMIT_NS) | (stamp + offsets[n] >= STAMP_LIMIT_NS)
        bracket[n] = -1
        if off:
            reason[n] = _TIME
        else:
            found = find_bracket(way[0], stamp + offsets[n], hint, max_gap_ns)
            bracket[n] = found
            hint = found if found >= 0 else hint
            reason[n] = 0 if found >= 0 else np.uint8(_NO_POSE)
    _exclude(x, y, z, reason, mounting, boxes)
    for n in range(size):
        px, py, pz = x[n], y[n], z[n]
        square = px * px + py * py + pz * pz
        v = _turn(mounting, px, py, pz)
        if bracket[n] < 0:
            reason[n] = _judge(reason[n], px, py, pz, square, v, limits)
            continue
        pose = interpolate(way, bracket[n], stamp + offsets[n])
        l = _turn(pose, mounting[9] + v[0], mounting[10] + v[1], mounting[11] + v[2])  # noqa: E741
        m = _turn(pose, v[0], v[1], v[2])
        reason[n] = _judge(reason[n], px, py, pz, square, m, limits)
        x[n] = pose[9] + l[0]
        y[n] = pose[10] + l[1]
        z[n] = pose[11] + l[2]
        if with_covariance:
            s = _covariance(l, m, square, beam, _spread(pose, mount))
            S[0, n] = s[0]
            S[1, n] = s[1]
            S[2, n] = s[2]
            S[3, n] = s[3]
            S[4, n] = s[4]
            S[5, n] = s[5]


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
