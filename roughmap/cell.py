"""What a cell remembers, and the names and numbers that all of the map agrees on."""

from enum import IntEnum

import numpy as np

TILE_SHIFT = 6
"""Tile of a cell: ``(i >> TILE_SHIFT, j >> TILE_SHIFT)``."""

TILE_CELLS = 1 << TILE_SHIFT
"""Cells along a tile's side."""

STATE_VERSION = 1
"""Rises when stored cells would mean something else; a store of another version is rebuilt, never converted."""

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
"""State of a cell: one cache line of 64 bytes. A cell never hit is 64 zero bytes, and ``count`` 0 says so.

``count``: points that touched it. ``updated``: largest ``floor(stamp / 1e9)`` of them. ``weight``: W = sum of w.
``weight_sq``: W2 = sum of w^2 / p. ``mean``: weighted mean height, metres. ``m2``: sum of w (h - mean)^2.
``min``, ``max``: heights. ``inv_cf``: sum of w / d^2 (eq. 16).
"""

STAMP_LIMIT_NS = (1 << 32) * 1_000_000_000
"""Stamps lie in [0, 2^32 s): whole seconds fit the cell's ``updated``."""

OFFSET_LIMIT_NS = 1_000_000_000
"""A point's own time lies at most this far after its scan's stamp."""


class PointReason(IntEnum):
    """Why a point was not used; the first that holds, in this order."""

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
"""The names under which rejected points are counted; index = ``PointReason``."""


class TooManyTiles(Exception):
    """A call needs more new tiles than it may make; no cell was written.

    ``new``: tiles it needs that are not there yet. ``limit``: how many it may make.
    """

    def __init__(self, new: int, limit: int) -> None:
        super().__init__(f"{new} new tiles are needed, {limit} are allowed")
        self.new = new
        self.limit = limit
