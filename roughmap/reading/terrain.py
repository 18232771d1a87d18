"""The layers that need neighbouring cells: gradients, slope, step height and traversability.

All planes have rows along y and columns along x. A plane of mean heights has a halo of one cell on each side; unknown
cells are NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isnan, nan, sqrt

import numpy as np

from roughmap.arrays import F8
from roughmap.jit import inline, kernel
from roughmap.reading.functions import atan
from roughmap.reading.layers import PaperLimits

NO_PLANE = np.empty((0, 0))
"""Placeholder for a plane that is not needed."""

UNLIMITED: PaperLimits = (inf, inf, inf, inf, inf)


@dataclass(frozen=True)
class Terrain:
    """The layers that need neighbours, each (ny, nx) float64, NaN where unknown."""

    gradient_x: F8
    gradient_y: F8
    slope: F8
    step_height: F8
    traversability: F8
    """Empty (0, 0) unless limits were given."""


@inline
def _difference(before: float, here: float, after: float, side: float) -> float:
    """Return the gradient along one axis: central, else one-sided, NaN without neighbours. ``here`` is known."""
    if isnan(after):
        return (here - before) / side
    if isnan(before):
        return (after - here) / side
    return (after - before) / (2.0 * side)


@inline
def _step(largest: float, here: float, neighbour: float) -> float:
    """Return the larger of ``largest`` and the step to a neighbour; an unknown neighbour (NaN) does not count."""
    step = abs(neighbour - here)
    return step if step > largest else largest


@inline
def _worse(least: float, term: float) -> float:
    """Return the smaller of two terms; 0 precedes NaN, and NaN precedes any other number."""
    if least == 0.0 or isnan(least):
        return 0.0 if term <= 0.0 else least
    if term > least:
        return least
    return max(term, 0.0) if term == term else nan  # noqa: PLR0124 - NaN stays NaN


@kernel
def _derive(
    mean: F8,
    side: float,
    limits: PaperLimits,
    std_dev: F8,
    extent: F8,
    confidence: F8,
    gradient_x: F8,
    gradient_y: F8,
    slope: F8,
    step_height: F8,
    traversability: F8,
) -> None:
    ny, nx = gradient_x.shape
    wanted = traversability.size > 0
    for j in range(ny):
        for i in range(nx):
            here = mean[j + 1, i + 1]
            if isnan(here):
                gradient_x[j, i] = nan
                gradient_y[j, i] = nan
                slope[j, i] = nan
                step_height[j, i] = nan
                if wanted:
                    traversability[j, i] = nan
                continue
            west, east = mean[j + 1, i], mean[j + 1, i + 2]
            south, north = mean[j, i + 1], mean[j + 2, i + 1]
            along_x = _difference(west, here, east, side)
            along_y = _difference(south, here, north, side)
            tilt = atan(sqrt(along_x * along_x + along_y * along_y))
            step = -1.0
            step = _step(step, here, west)
            step = _step(step, here, east)
            step = _step(step, here, south)
            step = _step(step, here, north)
            step = _step(step, here, mean[j, i])
            step = _step(step, here, mean[j, i + 2])
            step = _step(step, here, mean[j + 2, i])
            step = _step(step, here, mean[j + 2, i + 2])
            if step < 0.0:
                step = nan
            gradient_x[j, i] = along_x
            gradient_y[j, i] = along_y
            slope[j, i] = tilt
            step_height[j, i] = step
            if wanted:
                least = 1.0
                if limits[0] < inf:
                    least = _worse(least, 1.0 - tilt / limits[0])
                if limits[1] < inf:
                    least = _worse(least, 1.0 - step / limits[1])
                if limits[2] < inf:
                    least = _worse(least, 1.0 - std_dev[j, i] / limits[2])
                if limits[3] < inf:
                    least = _worse(least, 1.0 - extent[j, i] / limits[3])
                if limits[4] < inf:
                    least = _worse(least, confidence[j, i] / limits[4])
                traversability[j, i] = least


def derive(
    mean: F8,
    side: float,
    limits: PaperLimits | None = None,
    std_dev: F8 = NO_PLANE,
    extent: F8 = NO_PLANE,
    confidence: F8 = NO_PLANE,
) -> Terrain:
    """Compute gradients, slope, step height and, if ``limits`` are given, traversability.

    ``mean``: (ny + 2, nx + 2), mean heights in metres with their halo. ``side``: side of a cell in metres. ``std_dev``,
    ``extent`` (the layer ``range``) and ``confidence`` (``confidence_level``): (ny, nx), needed only if their limit is
    used. ``traversability`` is the least of clip(1 - v / limit, 0, 1), or clip(v / limit, 0, 1) for confidence, over
    the limits in use. It is 0 if any term is 0, else NaN if any term is NaN.
    """
    if mean.ndim != 2 or min(mean.shape) < 2:
        raise ValueError(f"mean has the shape {mean.shape}; expected two axes with a halo of one cell on each side")
    shape = (mean.shape[0] - 2, mean.shape[1] - 2)
    for plane, limit in zip((std_dev, extent, confidence), (UNLIMITED if limits is None else limits)[2:], strict=True):
        if limit < inf and plane.shape != shape:
            raise ValueError(f"a plane with a limit has the shape {plane.shape}; expected {shape}")
    gradient_x, gradient_y, slope, step = (np.empty(shape) for _ in range(4))
    traversability = NO_PLANE if limits is None else np.empty(shape)
    _derive(
        mean,
        side,
        UNLIMITED if limits is None else limits,
        std_dev,
        extent,
        confidence,
        gradient_x,
        gradient_y,
        slope,
        step,
        traversability,
    )
    return Terrain(gradient_x, gradient_y, slope, step, traversability)


def coarsen_least(children: Sequence[F8 | None]) -> F8:
    """Compute the traversability of a tile above level 0 from its four children: the least known of each 2 x 2 cells.

    ``children``: (n, n) planes in the order (2x, 2y), (2x+1, 2y), (2x, 2y+1), (2x+1, 2y+1), None where there is no
    tile. NaN where none of the four cells is known.
    """
    size = next(child.shape[0] for child in children if child is not None)
    out = np.full((size, size), np.nan)
    half = size // 2
    for place, child in enumerate(children):
        if child is not None:
            rows = np.fmin(child[0::2], child[1::2])
            j, i = (place >> 1) * half, (place & 1) * half
            np.fmin(rows[:, 0::2], rows[:, 1::2], out=out[j : j + half, i : i + half])
    return out
