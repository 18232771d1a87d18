"""The update of a cell by a point (eq. 5, 13-16), and the queue of pending updates."""

import numpy as np

from roughmap.arrays import F8, I8, U8, Scalar
from roughmap.jit import inline
from roughmap.points.footprint import POINT
from roughmap.tiles.slots import floats, words

QUEUE = 512
"""Length of the queue of pending updates: the cells, prefetched meanwhile, fit the first-level cache."""

RUN = 64
"""Most points that are queued together."""

_COUNT = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_SECOND = np.uint64(1_000_000_000)


@inline
def update_cell(head_of: U8, values: F8, h: Scalar, w: Scalar, q: Scalar, second: Scalar, min_distance: Scalar) -> None:
    """Update a cell, given as its eight words ``head_of`` and ``values``, with height ``h`` and weight ``w``.

    ``q`` = w / p of the point; ``second`` = floor(stamp / 1e9). With W the weight before:
    W' = W + w; g = w / W'; delta = h - mean; mean' = mean + delta g (eq. 5, 13); m2' = m2 + W g delta^2;
    W2' = W2 + w q; d = max(|h - mean'|, min_distance); inv_cf' = inv_cf + w / d^2 (eq. 16).
    """
    head = head_of[0]
    count = head & _COUNT
    updated = head >> _SHIFT
    updated = second if second > updated else updated
    W = values[1]
    mean = values[3]
    total = W + w
    g = w / total
    delta = h - mean
    low = values[5]
    high = values[6]
    if count == 0:
        mean = h
        low = h
        high = h
    else:
        mean = mean + delta * g
        low = min(low, h)
        high = max(high, h)
        values[4] += (W * g) * (delta * delta)
    d = max(abs(h - mean), min_distance)
    # The count stops at 2^32 - 1: wrapping to 0 would make the cell unknown.
    count = count if count == _COUNT else count + np.uint64(1)
    head_of[0] = count | (updated << _SHIFT)
    values[1] = total
    values[2] += w * q
    values[3] = mean
    values[5] = low
    values[6] = high
    values[7] += w / (d * d)


@inline
def drain(queue: Scalar, count: Scalar, z: F8, q: F8, stamps: I8, model: Scalar, min_distance: Scalar) -> None:
    """Apply the first ``count`` updates of a queue, in order.

    A loop for each case: a test inside costs as much as a tenth of an update.
    """
    cell, weight, point = queue
    if len(stamps) > 1:
        for c in range(count):
            n = np.uint64(point[c])
            density = q[n] if model != POINT else 1.0
            _apply(cell[c], weight[c], z[n], density, np.uint64(stamps[n]) // _SECOND, min_distance)
        return
    second = np.uint64(stamps[0]) // _SECOND
    if model == POINT:
        for c in range(count):
            _apply(cell[c], weight[c], z[np.uint64(point[c])], 1.0, second, min_distance)
        return
    for c in range(count):
        n = np.uint64(point[c])
        _apply(cell[c], weight[c], z[n], q[n], second, min_distance)


@inline
def _apply(address: Scalar, w: Scalar, h: Scalar, q: Scalar, second: Scalar, min_distance: Scalar) -> None:
    update_cell(words(address), floats(address), h, w, q, second, min_distance)
