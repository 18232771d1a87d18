"""The update of a cell by a point (eq. 5, 13-16)."""

import numpy as np

from roughmap.arrays import F8, U8, Scalar
from roughmap.jit import inline

_COUNT = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


@inline
def update_cell(
    heads: U8, values: F8, base: Scalar, h: Scalar, w: Scalar, q: Scalar, second: Scalar, min_distance: Scalar
) -> None:
    """Take up height ``h`` with weight ``w`` in the cell whose eight words begin at ``base`` of its slot.

    ``q`` = w / p of the point; ``second`` = floor(stamp / 1e9). With W the weight before:
    W' = W + w; g = w / W'; delta = h - mean; mean' = mean + delta g (eq. 5, 13); m2' = m2 + W g delta^2;
    W2' = W2 + w q; d = max(|h - mean'|, min_distance); inv_cf' = inv_cf + w / d^2 (eq. 16).
    """
    head = heads[base]
    count = head & _COUNT
    updated = head >> _SHIFT
    updated = second if second > updated else updated
    W = values[base + np.uint64(1)]
    mean = values[base + np.uint64(3)]
    total = W + w
    g = w / total
    delta = h - mean
    low = values[base + np.uint64(5)]
    high = values[base + np.uint64(6)]
    if count == 0:
        mean = h
        low = h
        high = h
    else:
        mean = mean + delta * g
        low = min(low, h)
        high = max(high, h)
        values[base + np.uint64(4)] += (W * g) * (delta * delta)
    d = max(abs(h - mean), min_distance)
    # A count of 2^32 - 1 stays: it would begin anew as a cell never hit.
    count = count if count == _COUNT else count + np.uint64(1)
    heads[base] = count | (updated << _SHIFT)
    values[base + np.uint64(1)] = total
    values[base + np.uint64(2)] += w * q
    values[base + np.uint64(3)] = mean
    values[base + np.uint64(5)] = low
    values[base + np.uint64(6)] = high
    values[base + np.uint64(7)] += w / (d * d)
