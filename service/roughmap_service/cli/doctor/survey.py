"""A look at one cloud's points: returns, equal points, ranges, and the tiles that it would touch."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roughmap.cell import TILE_CELLS
from roughmap_service.run.returns import repeated_returns

SOME = 256
"""Returns of a cloud that are kept."""

FARTHEST = 1e9
"""Metres. Greater distances count as this one."""


@dataclass(frozen=True)
class Survey:
    """Figures of one cloud.

    Attributes:
        points: all points; ``returns``: those that are finite and not (0, 0, 0).
        equal: how many points are rejected as ``duplicate_return``, and ``equal_at``: the first of them.
        ranges: 10th, 50th and 90th percentile and maximum of the returns' distances, metres.
        some: (M, 3) up to `SOME` returns, metres, in the sensor's frame.
        tile_ranges: of each tile that a return falls into, the distance of the nearest one, in ascending order.
    """

    points: int
    returns: int
    equal: int
    equal_at: tuple[float, float, float]
    ranges: tuple[float, float, float, float]
    some: NDArray[np.float64]
    tile_ranges: NDArray[np.float32]

    def tiles(self, max_range: float) -> int:
        """Return how many tiles the cloud touches within a range."""
        return int(np.searchsorted(self.tile_ranges, max_range, side="right"))


def survey(points: NDArray[np.floating[Any]], cell_size: float) -> Survey:
    """Look at points (N, 3) in metres, in the sensor's frame."""
    whole = np.asarray(points, np.float64)
    good = np.isfinite(whole).all(axis=1) & whole.any(axis=1)
    returns = np.ascontiguousarray(whole[good])
    if not len(returns):
        nothing = np.empty(0, np.float32)
        return Survey(len(whole), 0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), returns, nothing)
    with np.errstate(over="ignore"):
        distances = np.minimum(np.sqrt((returns * returns).sum(axis=1)), FARTHEST)
    quantiles = np.percentile(distances, [10, 50, 90, 100])
    marked = repeated_returns(points)
    equal = 0 if marked is None else int(marked.sum())
    x, y, z = (0.0, 0.0, 0.0) if marked is None else (float(value) for value in whole[int(np.argmax(marked))])
    return Survey(
        len(whole),
        len(returns),
        equal,
        (x, y, z),
        (float(quantiles[0]), float(quantiles[1]), float(quantiles[2]), float(quantiles[3])),
        returns[:: len(returns) // SOME + 1].copy(),
        _tile_ranges(returns, distances, cell_size * TILE_CELLS),
    )


def _tile_ranges(returns: NDArray[np.float64], distances: NDArray[np.float64], side: float) -> NDArray[np.float32]:
    """Return the nearest return's distance of each tile; turned with the robot, a cloud touches about as many."""
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = np.floor(returns[:, :2] / side)
    numbers = numbers[np.argsort(distances, kind="stable")]
    _, first = np.unique(np.ascontiguousarray(numbers + 0.0).view(np.complex128).ravel(), return_index=True)
    return np.sort(distances)[np.sort(first)].astype(np.float32)
