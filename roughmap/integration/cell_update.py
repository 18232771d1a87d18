"""The update of a cell by a point (eq. 5, 13-16)."""

import numpy as np

from roughmap.arrays import F8, U8, Scalar
from roughmap.jit import inline

_COUNT = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


@inline
def update_cell(
    head_of: U8, values: F8, h: Scalar, w: Scalar, q: Scalar, second: Scalar, min_distance: Scalar
) -> Scalar:
    """Update a cell, given as its eight words ``head_of`` and ``values``, with height ``h`` and weight ``w``; return g.

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
    return g
