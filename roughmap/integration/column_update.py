"""Points off the ground: the column of a cell, and when a new ground takes the place of the old one."""

import math

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import U8, Scalar
from roughmap.cell import BASED, COLUMN_BINS, COLUMN_DTYPE, SUPPORTED
from roughmap.integration.cell_update import update_cell
from roughmap.integration.trust_update import TRUST_WORDS, update_trust
from roughmap.intrinsics import never_inline, pointer
from roughmap.jit import inline, kernel
from roughmap.tiles.slots import floats, words

HITS = 3
"""So many hits confirm a ground; fewer can be strays."""

_MOST_HITS = 12
_POINTS_A_HIT = 5
"""A ground that many points support only gives way to more hits near below it: one for so many points of its own, at
most _MOST_HITS."""

_FAR_BELOW = 2.0
"""Metres. A ground that lies so far above the hits below it is a ceiling or a canopy: HITS are enough."""

_MEMORY = np.uint64(30)
"""Seconds without any point off the ground, after which single hits are forgotten."""

_BELOW = 11
"""The bins begin so many 0.1 m below the ground's 0.1 m."""

_BIN_BYTES = COLUMN_BINS // 2
_FIRST_BYTE = COLUMN_DTYPE.fields["bins"][1]  # type: ignore[index]
_FIRST_WORD = _FIRST_BYTE // 8
_COUNT_MOST = 15
_LOW = np.uint64(0xFFFF)
_LOW_HALF = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_FLAGS = np.uint64(16)
_SUPPORTED = np.uint64(SUPPORTED)
_BASED = np.uint64(BASED)
_EACH = np.uint64(0x1111111111111111)
_NIBBLE = np.uint64(15)
_ONE, _TWO, _THREE, _FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


@inline
def _hits(column: U8, k: Scalar) -> Scalar:
    """Return the hits in bin ``k``, 0 outside the column."""
    if k < 0 or k >= COLUMN_BINS:
        return np.int64(0)
    place = np.uint64(k)
    return np.int64((column[np.uint64(_FIRST_WORD) + (place >> _FOUR)] >> ((place & _NIBBLE) << _TWO)) & _NIBBLE)


@inline
def _hit(column: U8, k: Scalar, number: Scalar) -> None:
    """Add ``number`` hits to bin ``k``, up to 15 in all; do nothing outside the column."""
    if k >= 0 and k < COLUMN_BINS:
        place = np.uint64(k)
        more = min(number, _COUNT_MOST - _hits(column, k))
        column[np.uint64(_FIRST_WORD) + (place >> _FOUR)] += np.uint64(more) << ((place & _NIBBLE) << _TWO)


@inline
def _forget_single_hits(column: U8) -> None:
    for n in range(_FIRST_WORD, _FIRST_WORD + _BIN_BYTES // 8):
        bins = column[n]
        column[n] = bins ^ (bins & _EACH & ~((bins >> _ONE) | (bins >> _TWO) | (bins >> _THREE)))


@inline
def _shift_bins(address: Scalar, up: Scalar) -> None:
    """Move the bins by ``up`` bytes, down if it is negative; what leaves the column is lost."""
    bins = carray(pointer(address + np.uint64(_FIRST_BYTE), np.uint8(0)), (_BIN_BYTES,))
    if up > 0:
        for n in range(_BIN_BYTES - 1, -1, -1):
            bins[n] = bins[n - up] if n >= up else np.uint8(0)
    elif up < 0:
        for n in range(_BIN_BYTES):
            bins[n] = bins[n - up] if n - up < _BIN_BYTES else np.uint8(0)


@inline
def _base_of(height: Scalar) -> Scalar:
    """Return the base of the column of a ground at ``height``, in 0.1 m."""
    return np.int64(math.floor(10.0 * height)) - _BELOW


@inline
def _bin_of(height: Scalar, base: Scalar) -> Scalar:
    return np.int64(math.floor(20.0 * height)) - 2 * base


@kernel
def take_misfit(
    cell: Scalar,
    trust: Scalar,
    column: Scalar,
    h: float,
    w: float,
    q: float,
    second: Scalar,
    ms: Scalar,
    min_distance: float,
    band: float,
    common: Scalar,
    mount: Scalar,
    span: Scalar,
    up: bool,
) -> None:
    """Note a point that is not of the ground of its cell, and begin a new ground with it if enough points agree.

    ``cell``, ``trust``, ``column``: addresses of the cell's records. ``h``, ``w``, ``q``, ``second``,
    ``min_distance``: as in `update_cell`. ``ms``, ``common``, ``mount``, ``span``: as in `update_trust`. ``band``: see
    `MapSettings`. ``up``: the point can't be ground.
    """
    never_inline()
    head, values, state = words(cell), floats(cell), words(column)
    mean = values[3]
    count = np.int64(head[0] & _LOW_HALF)
    candidates = np.int64(state[0] & _LOW)
    flags = state[0] >> _FLAGS
    updated = state[2] & _LOW_HALF
    base = np.int64(np.int32(state[2] >> _SHIFT))
    if flags & _BASED == 0:
        flags |= _BASED
        base, updated = _base_of(mean), second
    if second > updated + _MEMORY:
        _forget_single_hits(state)
        candidates = np.int64(0)
    updated = max(updated, second)
    state[0] = np.uint64(candidates) | (flags << _FLAGS)
    state[2] = updated | (np.uint64(np.uint32(base)) << _SHIFT)
    k = _bin_of(h, base)
    supported = (flags & _SUPPORTED != 0) | (count >= HITS)
    if k >= COLUMN_BINS and (supported or up):
        return
    _hit(state, k, np.int64(1))
    above = h > mean
    if up or (above and supported):
        return
    if 0 <= k < COLUMN_BINS:
        needed = np.int64(HITS)
        if not (above or mean - h > _FAR_BELOW):
            needed = max(needed, min(np.int64(_MOST_HITS), count // _POINTS_A_HIT))
        if _hits(state, k - 1) + _hits(state, k) + _hits(state, k + 1) < needed:
            return
    else:
        other = floats(column)
        if candidates > 0 and abs(h - other[1]) <= band:
            candidates += 1
            other[1] += (h - other[1]) / candidates
        elif candidates > 1:
            candidates -= 1
        else:
            candidates = np.int64(1)
            other[1] = h
        state[0] = np.uint64(candidates) | (flags << _FLAGS)
        if candidates < HITS:
            return
    for n in range(8):
        head[n] = np.uint64(0)
    record = carray(pointer(trust, np.uint32(0)), (TRUST_WORDS,))
    for n in range(TRUST_WORDS):
        record[n] = np.uint32(0)
    g = update_cell(head, values, h, w, q, second, min_distance)
    update_trust(trust, g, common, mount, ms, span)
    below = _base_of(h)
    _shift_bins(column, base - below)
    _hit(state, _bin_of(mean, below), min(count, np.int64(_COUNT_MOST if mean > h else HITS - 1)))
    state[0] = (flags | _SUPPORTED) << _FLAGS
    state[2] = updated | (np.uint64(np.uint32(below)) << _SHIFT)
