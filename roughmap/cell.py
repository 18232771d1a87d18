"""The state of a cell, and the constants shared by the whole map."""

from enum import IntEnum

import numpy as np

TILE_SHIFT = 6
"""Tile of a cell: ``(i >> TILE_SHIFT, j >> TILE_SHIFT)``."""

TILE_CELLS = 1 << TILE_SHIFT
"""Cells along the side of a tile."""

STATE_VERSION = 2
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

TRUST_DTYPE = np.dtype(
    [
        ("variance", "<f4"),
        ("shared", "<f4"),
        ("pose_variance", "<f4"),
        ("mount_sigma", "<f4"),
        ("stamp_ms", "<u4"),
    ]
)
"""What a cell's mean height owes to errors that its points have in common: 20 bytes; zeros for an unknown cell.

``variance``: V, variance of the mean from the errors of the poses. ``shared``: L, covariance of the mean with the
present pose's error. ``pose_variance``: C, weighted mean of the points' variances from the poses. All three in square
metres. ``mount_sigma``: M, weighted mean of the points' sigmas from the mounting, metres. ``stamp_ms``:
floor(stamp / 1e6) modulo 2^32 of the newest update.
"""

COLUMN_BINS = 80
"""Height bins of a column: a nibble each, the lower half of a byte first."""

BIN_HEIGHT = 0.05
"""Height of a bin, metres."""

COLUMN_DTYPE = np.dtype(
    [
        ("candidates", "<u2"),
        ("flags", "<u2"),
        ("unused", "<u4"),
        ("candidate_mean", "<f8"),
        ("above_updated", "<u4"),
        ("base", "<i4"),
        ("bins", "u1", (COLUMN_BINS // 2,)),
    ]
)
"""What is above and below the ground in a cell: one cache line of 64 bytes, zeros where nothing was seen.

``candidates``, ``candidate_mean``: number and mean height, metres, of the points that may become a new ground outside
the bins. ``flags``: ``SUPPORTED`` | ``BASED``. ``above_updated``: largest whole second of the points off the ground.
``base``: lower end of the bins, in units of 0.1 m. ``bins``: hits in each bin, at most 15; bin k holds the heights in
[(2 base + k) 0.05, (2 base + k + 1) 0.05) m.
"""

SUPPORTED, BASED = 1, 2
"""Flags of a column: its ground has been confirmed; its bins are in use."""

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
