"""The state of a cell, and the constants shared by the whole map."""

from enum import IntEnum

import numpy as np

TILE_SHIFT = 6
"""Tile of a cell: ``(i >> TILE_SHIFT, j >> TILE_SHIFT)``."""

TILE_CELLS = 1 << TILE_SHIFT
"""Cells along the side of a tile."""

STATE_VERSION = 1
"""Raised when the meaning of stored cells changes. A store of another version is rebuilt, never converted."""

CELL_DTYPE = np.dtype(
    [
        ("count", "<u4"),
        ("updated", "<u4"),
        ("weight", "<f8"),
        ("weight_sq", "<f8"),
        ("mean", "<f8"),
        ("m2", "<f8"),
        ("min", "<f8"),
        ("max", "<f8"),
        ("inv_cf", "<f8"),
    ]
)
"""State of a cell: one cache line of 64 bytes. An unknown cell is 64 zero bytes; ``count`` is 0 only there.

``count``: number of points in the cell. ``updated``: their largest ``floor(stamp / 1e9)``. ``weight``: W = sum of w.
``weight_sq``: W2 = sum of w^2 / p. ``mean``: weighted mean height, metres. ``m2``: sum of w (h - mean)^2. ``min``,
``max``: heights, metres. ``inv_cf``: sum of w / d^2 (eq. 16).
"""

STAMP_LIMIT_NS = (1 << 32) * 1_000_000_000
"""Stamps lie in [0, 2^32 s): whole seconds fit the cell's ``updated``."""

OFFSET_LIMIT_NS = 1_000_000_000
"""The time of a point is at most this long after the stamp of its scan."""


class PointReason(IntEnum):
    """Why a point was not used. The first reason that applies, in this order, is reported."""

    KEPT = 0
    NOT_FINITE = 1
    NO_RETURN = 2
    TIME = 3
    NO_POSE = 4
    SELF = 5
    RANGE = 6
    CEILING = 7
    COVARIANCE = 8
    UNCERTAIN = 9
    BOUNDS = 10


REASON_NAMES = ("", *(reason.name.lower() for reason in PointReason if reason))
"""Names under which rejected points are counted; the index is the ``PointReason``."""


class TooManyTiles(Exception):
    """A call would create more tiles than allowed; no cell was written.

    ``new``: new tiles that the call needs. ``limit``: new tiles that it may create.
    """

    def __init__(self, new: int, limit: int) -> None:
        super().__init__(f"{new} new tiles needed, {limit} allowed")
        self.new = new
        self.limit = limit
