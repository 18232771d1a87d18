"""Points without a return that a driver moved off zero: hundreds of a cloud have exactly the same coordinates."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roughmap_schemas.point_times import sample

REPEATED: Final = 256
"""Points of a cloud with the same coordinates that are too many for returns."""

SAMPLED: Final = 2048
SHARE: Final = 32
"""A value is looked for among `SAMPLED` points, or one in `SHARE` if that is more."""

SEEN: Final = 3
"""How often the sample must have it: 256 points of 131,072 are in it eight times. Dual returns are in it twice."""

MOST: Final = 16
"""Different values of one cloud."""

FACTORS: Final = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def repeated_returns(points: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.bool_] | None:
    """Mark the points (N, 3) whose coordinates occur at least `REPEATED` times; None if there are none.

    Not those at (0, 0, 0) or not finite, which the map rejects itself. A value must appear in a sample, the same places
    for each cloud: it does if about a thousand points have it, or if the cloud has at most `SAMPLED` points.
    """
    if len(points) < REPEATED:
        return None
    taken = np.ascontiguousarray(sample(points, max(SAMPLED, len(points) // SHARE)))
    bits = taken.view(np.uint32 if taken.itemsize == 4 else np.uint64).astype(np.uint64)
    keys = bits @ FACTORS
    order = np.sort(keys)
    often = np.unique(order[SEEN - 1 :][order[SEEN - 1 :] == order[: 1 - SEEN]])
    marked: npt.NDArray[np.bool_] | None = None
    for key in often[:MOST]:
        value = taken[int(np.argmax(keys == key))]
        if not np.isfinite(value).all() or not value.any():
            continue
        rows = np.flatnonzero(points[:, 0] == value[0])
        rows = rows[(points[rows] == value).all(axis=1)]
        if len(rows) >= REPEATED:
            marked = np.zeros(len(points), np.bool_) if marked is None else marked
            marked[rows] = True
    return marked
