"""Placement of points that have times of their own, each with the pose at its time (eq. 1)."""

import math
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8, I8, U1, Scalar
from roughmap.cell import OFFSET_LIMIT_NS, STAMP_LIMIT_NS, PointReason
from roughmap.jit import inline
from roughmap.points.place import (
    BLOCK,
    BRACKET,
    COMMON,
    FRACTION,
    MOUNT,
    PLANES,
    QUAT,
    REASON,
    SINCE,
    STRIDE,
    UNTIL,
    UP,
    S,
    X,
    Y,
    Z,
    first_reason,
    fixed_shape,
    is_uncertain,
    place,
    reject_above,
    reject_own_body,
    set_covariance,
    set_heights,
)
from roughmap.points.propagation import shared_terms
from roughmap.points.rotations import rotation_matrix
from roughmap.points.trajectory import covariance_at, find_bracket, pose_pair, position_at, quaternion_at

STEP = 16
"""Runs of points with the same bracket are extended to multiples of this length: a loop of constant length vectorises
without a remainder."""

_NO_BRACKET, _PLACED = -1, -2
"""Values of ``bracket`` for points without a pose and for points already placed."""

_FEW_POSES = 64
"""Up to so many poses in a block's times, counting those before each point is faster than searching for them."""

_MANY_RUNS = 40
"""A block with more runs than this is placed bracket by bracket."""

_TIME = float(PointReason.TIME)
_NO_POSE = float(PointReason.NO_POSE)


class MovingScratch(NamedTuple):
    """Scratch for a block of points with times.

    ``bracket`` (BLOCK,): see `_find_brackets`. ``order``, ``ends``, ``planes``: see `_place_by_bracket`.
    """

    bracket: I8
    order: I8
    ends: I8
    planes: F8


def moving_scratch() -> MovingScratch:
    """Allocate it."""
    return MovingScratch(
        np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.int64), np.zeros((PLANES, STRIDE))
    )


@inline
def _search_brackets(
    P: F8, offsets: I8, first: Scalar, size: Scalar, bracket: I8, stamp: Scalar, stamps: I8, max_gap_ns: Scalar
) -> None:
    """Find the brackets of any times, with a search for each point whose time is not in the last one's bracket."""
    for n in range(BLOCK):
        P[BRACKET, n] = -1.0
        P[SINCE, n] = 0.0
        P[UNTIL, n] = 0.0
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
            P[REASON, n] = 0.0
            P[BRACKET, n] = float(bracket[n])
            P[SINCE, n] = float(t - before)
            P[UNTIL, n] = float(after - t)
        else:
            bracket[n] = _NO_BRACKET
            P[REASON, n] = _TIME if off else _NO_POSE


@inline
def _count_brackets(
    P: F8, offsets: I8, first: Scalar, size: Scalar, bracket: I8, stamp: Scalar, stamps: I8, max_gap_ns: Scalar
) -> Scalar:
    """Find the brackets by counting the poses before each point, in any order of times and without a branch.

    Returns False, with nothing done, if a time is out of range, before the first pose or past the last one, or if too
    many poses lie between the times.
    """
    # Indices without a sign: one that may be negative is adjusted, and no loop with that vectorises.
    start, count = np.uint64(first), np.uint64(size)
    earliest = latest = offsets[start]
    for n in range(count):
        earliest, latest = min(earliest, offsets[start + n]), max(latest, offsets[start + n])
    if earliest < 0 or latest > OFFSET_LIMIT_NS or stamp + latest >= STAMP_LIMIT_NS:
        return False
    low, _, _, _ = find_bracket(stamps, stamp + earliest, max_gap_ns)
    high, _, _, _ = find_bracket(stamps, stamp + latest, max_gap_ns)
    if low < 0 or high + 1 >= len(stamps) or high - low > _FEW_POSES:
        return False
    for n in range(count):
        bracket[n] = low
    for pose in range(low + 1, high + 1):
        since = stamps[pose] - stamp
        for n in range(count):
            bracket[n] += np.int64(1) if offsets[start + n] >= since else np.int64(0)
    for n in range(count):
        before, after = stamps[np.uint64(bracket[n])], stamps[np.uint64(bracket[n]) + np.uint64(1)]
        t = stamp + offsets[start + n]
        exact = t == before
        known = exact | (float(after - before) <= max_gap_ns)
        which = 2 * bracket[n] + (np.int64(1) if exact else np.int64(0))
        bracket[n] = which if known else np.int64(_NO_BRACKET)
        P[REASON, n] = 0.0 if known else _NO_POSE
        P[BRACKET, n] = float(which) if known else -1.0
        P[SINCE, n] = float(t - before) if known else 0.0
        P[UNTIL, n] = float(after - t) if known else 0.0
    for k in range(size, BLOCK):
        P[BRACKET, k] = -1.0
        P[SINCE, k] = 0.0
        P[UNTIL, k] = 0.0
    return True


@inline
def _find_brackets(
    P: F8, offsets: I8, first: Scalar, size: Scalar, bracket: I8, stamp: Scalar, stamps: I8, max_gap_ns: Scalar
) -> None:
    """Find the bracket of each point's time: 2 * index of the pose before, + 1 if the time is that pose's own stamp.

    Points without a pose get _NO_BRACKET and a reason.
    """
    if not _count_brackets(P, offsets, first, size, bracket, stamp, stamps, max_gap_ns):
        _search_brackets(P, offsets, first, size, bracket, stamp, stamps, max_gap_ns)


@inline
def _place_run(
    P: F8, which: Scalar, path: Scalar, start: Scalar, stop: Scalar, with_covariance: Scalar, rules: Scalar
) -> None:
    """Place the points ``start`` to ``stop``, whose times lie in bracket ``which``.

    The loops go over whole steps, and place all points of the bracket in these.
    """
    mounting, beam, mount, limits, _ = rules
    pair = pose_pair(path, which >> 1, which & 1 == 1)
    low, high = start // STEP * STEP, (stop + STEP - 1) // STEP * STEP
    own = float(which)
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            q, u = quaternion_at(pair, P[SINCE, n], P[UNTIL, n])
            P[FRACTION, n] = u
            P[QUAT, n] = q[0]
            P[QUAT + 1, n] = q[1]
            P[QUAT + 2, n] = q[2]
            P[QUAT + 3, n] = q[3]
    for first in range(low, high, STEP):
        for k in range(STEP):
            n = np.uint64(first) + np.uint64(k)
            r = rotation_matrix(P[QUAT, n], P[QUAT + 1, n], P[QUAT + 2, n], P[QUAT + 3, n])
            place(P, n, r, position_at(pair, P[FRACTION, n]), P[BRACKET, n] == own, mounting, limits)
    if limits[2] < math.inf:
        for k in range(low, high):
            reject_above(P, k, P[BRACKET, k] == own, limits)
    if is_uncertain(mount):
        _set_moving(P, own, pair, low, high, beam, mount, True, with_covariance)
    else:
        _set_moving(P, own, pair, low, high, beam, mount, False, with_covariance)


@inline
def _terms_at(P: F8, n: Scalar, pair: Scalar, mount: Scalar, mounted: Scalar) -> Scalar:
    """Return `shared_terms` of the pose at the time of point ``n``."""
    r = rotation_matrix(P[QUAT, n], P[QUAT + 1, n], P[QUAT + 2, n], P[QUAT + 3, n])
    return shared_terms((*r, 0.0, 0.0, 0.0, *covariance_at(pair, P[FRACTION, n])), mount, mounted)


@inline
def _set_moving(
    P: F8, own: Scalar, pair: Scalar, low: Scalar, high: Scalar, beam: Scalar, mount: Scalar, mounted: Scalar,
    with_covariance: Scalar,
) -> None:  # fmt: skip
    if with_covariance:
        for first in range(low, high, STEP):
            for k in range(STEP):
                n = np.uint64(first) + np.uint64(k)
                terms = _terms_at(P, n, pair, mount, mounted)
                set_covariance(P, n, P[BRACKET, n] == own, beam, terms, mounted)
    else:
        for first in range(low, high, STEP):
            for k in range(STEP):
                n = np.uint64(first) + np.uint64(k)
                set_heights(P, n, P[BRACKET, n] == own, _terms_at(P, n, pair, mount, mounted), mounted)


@inline
def _place_by_bracket(
    P: F8, size: Scalar, scratch: Scalar, path: Scalar, with_covariance: Scalar, rules: Scalar
) -> None:
    """Place a block whose points lie in no order of time, bracket by bracket; do nothing if there are few runs.

    The points are counted by bracket, copied to ``planes`` as one run for each bracket, placed there, and copied back.
    ``ends``: where the run of each bracket ends; ``order``: the points, run by run.
    """
    bracket, order, ends = scratch.bracket, scratch.order, scratch.ends
    runs, highest = np.int64(1), bracket[0]
    for n in range(1, size):
        runs += np.int64(1) if bracket[n] != bracket[n - 1] else np.int64(0)
        highest = max(highest, bracket[n])
    lowest = highest
    for n in range(size):
        lowest = min(lowest, bracket[n] if bracket[n] >= 0 else highest)
    if runs <= _MANY_RUNS or highest - lowest >= BLOCK:
        return
    kinds = highest - lowest + 1
    ends[:kinds] = 0
    for n in range(size):
        if bracket[n] >= 0:
            ends[bracket[n] - lowest] += 1
    number = np.int64(0)
    for kind in range(kinds):
        number, ends[kind] = number + ends[kind], number
    for n in range(size):
        if bracket[n] >= 0:
            order[ends[bracket[n] - lowest]] = n
            ends[bracket[n] - lowest] += 1
    Q = fixed_shape(scratch.planes)
    for k in range(number):
        n = order[k]
        for row in (X, Y, Z, REASON, BRACKET, SINCE, UNTIL):
            Q[row, k] = P[row, n]
    for k in range(number, BLOCK):
        Q[BRACKET, k] = -1.0
    start = np.int64(0)
    for kind in range(kinds):
        stop = ends[kind]
        if stop > start:
            _place_run(Q, kind + lowest, path, start, stop, with_covariance, rules)
        start = stop
    for k in range(number):
        n = order[k]
        bracket[n] = _PLACED
        for row in (X, Y, Z, REASON, S, S + 1, S + 2, S + 3, S + 4, S + 5, COMMON, MOUNT, UP):
            P[row, n] = Q[row, k]


@inline
def place_moving(
    planes: F8,
    reason: U1,
    offsets: I8,
    first: int,
    size: int,
    scratch: Scalar,
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
    P = fixed_shape(planes)
    bracket = scratch.bracket
    _find_brackets(P, offsets, first, size, bracket, stamp, path[0], max_gap_ns)
    reject_own_body(P, rules[0], rules[4])
    _place_by_bracket(P, size, scratch, path, with_covariance, rules)
    start = 0
    while start < size:
        which = bracket[start]
        stop = start + 1
        while stop < size and bracket[stop] == which:
            stop += 1
        if which >= 0:
            _place_run(P, which, path, start, stop, with_covariance, rules)
            for n in range(start, (stop + STEP - 1) // STEP * STEP):  # also points of this bracket after the run
                bracket[n] = _PLACED if bracket[n] == which else bracket[n]
        elif which == _NO_BRACKET:
            for n in range(start, stop):
                P[REASON, n] = first_reason(P[REASON, n], P[X, n], P[Y, n], P[Z, n], False)
        start = stop
    for n in range(BLOCK):
        reason[n] = np.uint8(P[REASON, n])
