"""Which cells' ground is known: confirmed by enough points, and not hanging over other ground."""

import numpy as np

from roughmap.arrays import F8
from roughmap.cell import TILE_CELLS
from roughmap.jit import inline, kernel
from roughmap.reading.halo import Halo
from roughmap.settings import ground_band

ENOUGH = 1.5
"""Points, in the cell and in the neighbours at its height, that confirm a ground: a lone point may be a stray."""


@inline
def _beside(mean: F8, expected: F8, j: int, i: int, here: float, height: float) -> float:
    """Return the points of a neighbour whose height is near ``here``. Infinite heights are near none."""
    return expected[j, i] if abs(mean[j, i] - here) <= height else 0.0


@kernel
def _supported(mean: F8, expected: F8, confirmed: F8, height: float, out: F8) -> None:
    """Write the heights of the cells that are confirmed to ``out``, which is one cell less wide on each side."""
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            here = mean[j + 1, i + 1]
            points = expected[j + 1, i + 1]
            points += _beside(mean, expected, j, i, here, height)
            points += _beside(mean, expected, j, i + 1, here, height)
            points += _beside(mean, expected, j, i + 2, here, height)
            points += _beside(mean, expected, j + 1, i, here, height)
            points += _beside(mean, expected, j + 1, i + 2, here, height)
            points += _beside(mean, expected, j + 2, i, here, height)
            points += _beside(mean, expected, j + 2, i + 1, here, height)
            points += _beside(mean, expected, j + 2, i + 2, here, height)
            out[j, i] = here if points >= ENOUGH or confirmed[j + 1, i + 1] > 0.0 else np.inf


@kernel
def _standing(height: F8, window: int, clearance: float, low: F8, out: F8) -> None:
    """Write the heights of the cells that do not hang to ``out``, which is ``window`` cells less wide on each side.

    ``low``: room for the least height along each row.
    """
    rows, columns = out.shape
    span = 2 * window + 1
    for j in range(low.shape[0]):
        for i in range(columns):
            low[j, i] = height[j, i]
        for k in range(1, span):
            for i in range(columns):
                low[j, i] = height[j, i + k] if height[j, i + k] < low[j, i] else low[j, i]
    for j in range(rows):
        for i in range(columns):
            out[j, i] = low[j, i]
        for k in range(1, span):
            for i in range(columns):
                out[j, i] = low[j + k, i] if low[j + k, i] < out[j, i] else out[j, i]
        for i in range(columns):
            here = height[j + window, i + window]
            out[j, i] = np.inf if here - out[j, i] > clearance else here


def supported(halo: Halo, side: float) -> F8:
    """Return the heights of level-0 cells whose ground is confirmed, infinite elsewhere; a cell less on each side.

    It is confirmed by what came after it, or by the points of the cell and those neighbours that are at its height.
    """
    size = halo.mean.shape[0] - 2
    out = np.empty((size, size))
    _supported(halo.mean, halo.expected, halo.confirmed, ground_band(side), out)
    return out


def confirmed(halo: Halo) -> F8:
    """Return the same above level 0, where the flags say all."""
    return np.where(halo.confirmed > 0.0, halo.mean, np.inf)[1:-1, 1:-1].copy()


def standing(height: F8, window: int, clearance: float) -> F8:
    """Return the heights without those more than ``clearance`` above the lowest one within ``window`` cells, along x
    and y; infinite where unknown; ``window`` cells less on each side."""
    size = height.shape[0] - 2 * window
    out = np.empty((size, size))
    _standing(height, window, clearance, np.empty((height.shape[0], size)), out)
    return out


def inner(plane: F8) -> F8:
    """Return the tile's own part of a plane."""
    width = (plane.shape[0] - TILE_CELLS) // 2
    return plane[width : width + TILE_CELLS, width : width + TILE_CELLS]
