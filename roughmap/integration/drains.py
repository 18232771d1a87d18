"""The queue of pending updates: cells and their trust, in the order of the points."""

import numpy as np
from numba.np.numpy_support import carray

from roughmap.arrays import I8, U8, Scalar
from roughmap.cell import CELL_DTYPE, COLUMN_DTYPE
from roughmap.integration.cell_update import update_cell
from roughmap.integration.column_update import take_misfit
from roughmap.integration.trust_update import alike_for, update_trust
from roughmap.intrinsics import never_inline, pointer
from roughmap.jit import inline, kernel
from roughmap.points.footprint import POINT
from roughmap.tiles.slots import floats, words

QUEUE = 512
"""Length of the queue of pending updates: the cells, prefetched meanwhile, fit the first-level caches."""

RUN = 64
"""Most points that are queued together."""

ROW = np.uint64(32)
"""Bits of a queued point that hold its number; the row of its tile is above them."""

_NUMBER = np.uint64(0xFFFFFFFF)
_SECOND = np.uint64(1_000_000_000)
_MILLISECOND = np.uint64(1_000_000)
_CELL = np.uint64(CELL_DTYPE.itemsize)
_COLUMN = np.uint64(COLUMN_DTYPE.itemsize)
_UP = np.uint64(1)

_WORDS = 4
ENTRY = np.uint64(8 * _WORDS)
"""Bytes of a queued update, four words: the address of the cell, + 1 if the point looks up; the weight, negative in the
cell of the point's largest share; the number of the point, + 2^ROW times the row of the tile; the address of the cell's
trust. One after the other, so that kernels need one address for them: with four arrays they run out of registers."""
_CELL_WORD, _WEIGHT_WORD, _POINT_WORD, _TRUST_WORD = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)

TILE_WORDS = 3
_TILE = np.uint64(8 * TILE_WORDS)
_CELLS, _COLUMNS, _BASED = np.uint64(0), np.uint64(1), np.uint64(2)


@inline
def put(at: Scalar, cell: Scalar, weight: Scalar, point: Scalar, trust: Scalar) -> None:
    """Write an update to the queue at the address ``at``; see `ENTRY`."""
    entry, floating = carray(pointer(at, np.uint64(0)), (_WORDS,)), carray(pointer(at, np.float64(0.0)), (_WORDS,))
    entry[_CELL_WORD] = cell
    floating[_WEIGHT_WORD] = weight
    entry[_POINT_WORD] = point
    entry[_TRUST_WORD] = trust


@inline
def _queued(at: Scalar) -> Scalar:
    """Return the update at the address ``at``."""
    entry, floating = carray(pointer(at, np.uint64(0)), (_WORDS,)), carray(pointer(at, np.float64(0.0)), (_WORDS,))
    return entry[_CELL_WORD], floating[_WEIGHT_WORD], entry[_POINT_WORD], entry[_TRUST_WORD]


@inline
def _times(stamp: Scalar) -> Scalar:
    """Return whole seconds, and milliseconds modulo 2^32."""
    t = np.uint64(stamp)
    return t // _SECOND, np.uint32(t // _MILLISECOND)


@kernel
def drain_all(
    start: Scalar, stop: Scalar, planes: Scalar, stamps: I8, model: int, min_distance: float, pose_error_time: float
) -> None:
    """Apply the updates from the address ``start`` up to ``stop``, in order: every point counts.

    A loop for each case: a test inside costs as much as a tenth of an update.
    """
    never_inline()
    z, q, common, mount = planes.z, planes.q, planes.common, planes.mount
    span = alike_for(pose_error_time)
    if len(stamps) > 1:
        for at in range(start, stop, ENTRY):
            cell, weight, point, trust = _queued(at)
            n = point & _NUMBER
            density = q[n] if model != POINT else 1.0
            second, ms = _times(stamps[n])
            _apply(cell, trust, abs(weight), z[n], density, second, min_distance, common[n], mount[n], ms, span)
        return
    second, ms = _times(stamps[0])
    if model == POINT:
        for at in range(start, stop, ENTRY):
            cell, weight, point, trust = _queued(at)
            n = point & _NUMBER
            _apply(cell, trust, 1.0, z[n], 1.0, second, min_distance, common[n], mount[n], ms, span)
        return
    for at in range(start, stop, ENTRY):
        cell, weight, point, trust = _queued(at)
        n = point & _NUMBER
        _apply(cell, trust, abs(weight), z[n], q[n], second, min_distance, common[n], mount[n], ms, span)


@inline
def _apply(
    address: Scalar, trust: Scalar, w: Scalar, h: Scalar, q: Scalar, second: Scalar, min_distance: Scalar,
    common: Scalar, mount: Scalar, ms: Scalar, span: Scalar,
) -> None:  # fmt: skip
    g = update_cell(words(address), floats(address), h, w, q, second, min_distance)
    update_trust(trust, g, common, mount, ms, span)


@kernel
def drain_ground(
    start: Scalar,
    stop: Scalar,
    planes: Scalar,
    stamps: I8,
    model: int,
    min_distance: float,
    pose_error_time: float,
    band: float,
    tiles: U8,
) -> None:
    """Do the same for a map of the ground.

    ``tiles`` (T, TILE_WORDS): for each row, the addresses of the cells and of the columns, and a word that is set to 1
    when a column comes into use.
    """
    never_inline()
    z, q, common, mount = planes.z, planes.q, planes.common, planes.mount
    span = alike_for(pose_error_time)
    table = np.uint64(tiles.ctypes.data)  # no array is passed on: each call would count references
    if len(stamps) > 1:
        for at in range(start, stop, ENTRY):
            cell, weight, point, trust = _queued(at)
            n = point & _NUMBER
            density = q[n] if model != POINT else 1.0
            second, ms = _times(stamps[n])
            _take(
                cell, trust, weight, z[n], density, second, min_distance, common[n], mount[n], ms, span, band,
                model == POINT, point, table,
            )  # fmt: skip
        return
    second, ms = _times(stamps[0])
    if model == POINT:
        for at in range(start, stop, ENTRY):
            cell, weight, point, trust = _queued(at)
            n = point & _NUMBER
            _take(
                cell, trust, 1.0, z[n], 1.0, second, min_distance, common[n], mount[n], ms, span, band, True,
                point, table,
            )  # fmt: skip
        return
    for at in range(start, stop, ENTRY):
        cell, weight, point, trust = _queued(at)
        n = point & _NUMBER
        _take(
            cell, trust, weight, z[n], q[n], second, min_distance, common[n], mount[n], ms, span, band, False,
            point, table,
        )  # fmt: skip


@inline
def _take(
    word: Scalar, trust: Scalar, weight: Scalar, h: Scalar, q: Scalar, second: Scalar, min_distance: Scalar,
    common: Scalar, mount: Scalar, ms: Scalar, span: Scalar, band: Scalar, alone: Scalar, point: Scalar, table: Scalar,
) -> None:  # fmt: skip
    """Apply one update. ``alone``: the point has no other cell."""
    up = word & _UP
    address = word ^ up
    w = abs(weight)
    known = np.uint32(words(address)[0]) != 0
    if (up != 0) | (known & (abs(h - floats(address)[3]) > band)):
        if known & (alone | (weight < 0.0)):
            tile = carray(pointer(table + (point >> ROW) * _TILE, np.uint64(0)), (TILE_WORDS,))
            tile[_BASED] = 1
            column = tile[_COLUMNS] + (address - tile[_CELLS]) // _CELL * _COLUMN
            take_misfit(address, trust, column, h, w, q, second, ms, min_distance, band, common, mount, span, up != 0)
        return
    g = update_cell(words(address), floats(address), h, w, q, second, min_distance)
    update_trust(trust, g, common, mount, ms, span)
