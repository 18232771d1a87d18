"""The ground around a cell as a plane: gradients, slope, roughness; and the drop beside it."""

from dataclasses import dataclass
from functools import lru_cache
from math import nan, sqrt

import numpy as np

from roughmap.arrays import F8, I8, Scalar
from roughmap.cell import TILE_CELLS
from roughmap.jit import inline, kernel
from roughmap.reading.functions import atan, tan
from roughmap.reading.halo import Halo
from roughmap.tiles.reach import LARGEST_FOOTPRINT

FEWEST = 4.0
"""Cells that a plane needs."""

NEAR = 0.3
"""Within this distance, metres, a drop is a step however steep the ground; beyond, a plane's own drop is none."""

FAR = 1e300
"""More than any difference of heights, less than to an unknown one."""

VALUES = 4
ROW = TILE_CELLS + 2 * LARGEST_FOOTPRINT
TO_WEIGHT, TO_SCATTER, TO_FREE = ROW, 2 * ROW, 3 * ROW
"""Each row of cells is four rows of ROW numbers: heights, weights, scatter, freedom (see `Halo`). So far is it from a
cell's height to its other values."""

SUMS = 13 * TILE_CELLS
W, WX, WXX, WZ, WXZ, WZZ, CELLS, WY, WXY, WYY, WYZ, SCATTER, FREE = range(0, SUMS, TILE_CELLS)
"""Where the sums of a row of 64 cells begin: over each cell's footprint, x, y, z counted from that cell."""


@dataclass(frozen=True)
class PlaneLayers:
    """Layers of a tile, each (64, 64) float64, NaN where unknown. Without a plane there is a step height alone."""

    gradient_x: F8
    gradient_y: F8
    slope: F8
    step_height: F8
    roughness: F8


@inline
def _first(here: F8, cells: F8, limit: float, sums: F8) -> None:
    """Begin the sums of 64 centres with the cells straight above or below them."""
    for i in range(TILE_CELLS):
        z = cells[i] - here[i]
        near = abs(z) <= limit
        z = z if near else 0.0
        w = cells[TO_WEIGHT + i] if near else 0.0
        sums[W + i] = w
        sums[WX + i] = 0.0
        sums[WXX + i] = 0.0
        sums[WZ + i] = w * z
        sums[WXZ + i] = 0.0
        sums[WZZ + i] = w * z * z
        sums[CELLS + i] = 1.0 if near else 0.0
        sums[SCATTER + i] = cells[TO_SCATTER + i] if near else 0.0
        sums[FREE + i] = cells[TO_FREE + i] if near else 0.0


@inline
def _pair(here: F8, left: F8, right: F8, dx: float, limit: float, sums: F8) -> None:
    """Add the cells that are ``dx`` to the left and to the right."""
    for i in range(TILE_CELLS):
        z, y = right[i] - here[i], left[i] - here[i]
        near, also = abs(z) <= limit, abs(y) <= limit
        z, y = z if near else 0.0, y if also else 0.0
        w, v = right[TO_WEIGHT + i] if near else 0.0, left[TO_WEIGHT + i] if also else 0.0
        wz, vy = w * z, v * y
        sums[W + i] += w + v
        sums[WX + i] += dx * (w - v)
        sums[WXX + i] += dx * dx * (w + v)
        sums[WZ + i] += wz + vy
        sums[WXZ + i] += dx * (wz - vy)
        sums[WZZ + i] += wz * z + vy * y
        sums[CELLS + i] += (1.0 if near else 0.0) + (1.0 if also else 0.0)
        sums[SCATTER + i] += (right[TO_SCATTER + i] if near else 0.0) + (left[TO_SCATTER + i] if also else 0.0)
        sums[FREE + i] += (right[TO_FREE + i] if near else 0.0) + (left[TO_FREE + i] if also else 0.0)


@inline
def _gather(sums: F8, dy: float, total: F8) -> None:
    """Add the sums over one row of the footprint, ``dy`` from the centre, to those over all of it."""
    for i in range(TILE_CELLS):
        total[W + i] += sums[W + i]
        total[WX + i] += sums[WX + i]
        total[WXX + i] += sums[WXX + i]
        total[WZ + i] += sums[WZ + i]
        total[WXZ + i] += sums[WXZ + i]
        total[WZZ + i] += sums[WZZ + i]
        total[CELLS + i] += sums[CELLS + i]
        total[SCATTER + i] += sums[SCATTER + i]
        total[FREE + i] += sums[FREE + i]
        total[WY + i] += dy * sums[W + i]
        total[WXY + i] += dy * sums[WX + i]
        total[WYY + i] += dy * dy * sums[W + i]
        total[WYZ + i] += dy * sums[WZ + i]


@inline
def _solve(here: F8, total: F8, side: float, gx: F8, gy: F8, slope: F8, roughness: F8) -> None:
    """Compute a row of the layers from the sums over the footprints."""
    for i in range(TILE_CELLS):
        whole = total[W + i]
        x, y, z = total[WX + i] / whole, total[WY + i] / whole, total[WZ + i] / whole
        xx, xy, yy = total[WXX + i] / whole - x * x, total[WXY + i] / whole - x * y, total[WYY + i] / whole - y * y
        xz, yz, zz = total[WXZ + i] / whole - x * z, total[WYZ + i] / whole - y * z, total[WZZ + i] / whole - z * z
        extent = xx + yy
        determinant = xx * yy - xy * xy
        flat = determinant < 1e-3 * extent * extent + 1e-12 or extent < 0.3 * side * side
        none = total[CELLS + i] < FEWEST or flat or here[i] == np.inf
        along, up = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
        along, up = nan if none else along, nan if none else up
        square = along * along + up * up
        residual = zz - along * xz - up * yz
        # what a tilted plane spreads the heights within a cell by is not roughness
        within = total[SCATTER + i] / total[FREE + i] - square * side * side / 12.0
        within = 0.0 if within < 0.0 or total[FREE + i] < 1.0 else within
        gx[i] = along
        gy[i] = up
        slope[i] = atan(sqrt(square))
        roughness[i] = sqrt((0.0 if residual < 0.0 else residual) + within)


@inline
def _row(cells: F8, y: Scalar, x: Scalar) -> F8:
    """Return the cells of row ``y`` from ``x`` on, their values ROW apart; the length leaves room for 64 cells."""
    place = y * (VALUES * ROW) + x
    return cells[place : place + TO_FREE + TILE_CELLS]


@kernel
def _fit(cells: F8, side: float, most: F8, sums: F8, total: F8, out: F8) -> None:
    """Fill gradients, slope and roughness in ``out`` (5, 64, 64). ``sums``, ``total``: room for the sums of 64 cells.

    ``cells``: rows of VALUES times ROW numbers: heights, weights, scatter, freedom. ``most`` (r + 1, r + 1): largest
    difference of height by distance along y and x. With all distances in a row constant, the compiler knows that what
    is summed and the sums don't overlap.
    """
    radius = len(most) - 1
    circle = radius * radius + radius
    for j in range(TILE_CELLS):
        here = _row(cells, radius + j, radius)
        total[:] = 0.0
        for dj in range(-radius, radius + 1):
            y = radius + j + dj
            limits = most[abs(dj)]
            _first(here, _row(cells, y, radius), limits[0], sums)
            for k in range(1, radius + 1):
                if k * k + dj * dj > circle:
                    break
                _pair(here, _row(cells, y, radius - k), _row(cells, y, radius + k), k * side, limits[k], sums)
            _gather(sums, dj * side, total)
        _solve(here, total, side, out[0, j], out[1, j], out[2, j], out[4, j])


@inline
def _lower(there: F8, lowest: F8) -> None:
    for i in range(TILE_CELLS):
        lowest[i] = there[i] if there[i] < lowest[i] else lowest[i]


@inline
def _below(here: F8, lowest: F8, step: F8) -> None:
    for i in range(TILE_CELLS):
        step[i] = here[i] - lowest[i] if here[i] < np.inf else nan


@inline
def _below_plane(here: F8, there: F8, gx: F8, gy: F8, dx: float, dy: float, step: F8) -> None:
    """Raise the step by a cell beyond NEAR, without the part that the plane falls from there on."""
    distance = sqrt(dx * dx + dy * dy)
    beyond = (distance - NEAR) / distance
    for i in range(TILE_CELLS):
        own = abs(gx[i] * dx + gy[i] * dy) * beyond
        own = own if own >= 0.0 else 0.0  # there may be no plane
        drop = here[i] - there[i] - own
        step[i] = drop if drop > step[i] else step[i]


@kernel
def _drop(cells: F8, radius: int, side: float, near: I8, far: I8, lowest: F8, out: F8) -> None:
    """Fill step heights in ``out`` (5, 64, 64), whose gradients are there. ``cells``: as in `_fit`.

    ``near`` (2 r + 1,): how many cells along x are within reach and NEAR, by row; -1 for none. ``far`` (F, 2): offsets
    along y and x of further cells within reach. ``lowest`` (64,): room.
    """
    for j in range(TILE_CELLS):
        y = radius + j
        here = _row(cells, y, radius)
        lowest[:] = np.inf
        for dj in range(-radius, radius + 1):
            for k in range(-near[dj + radius], near[dj + radius] + 1):
                _lower(_row(cells, y + dj, radius + k), lowest)
        _below(here, lowest, out[3, j])
        for n in range(len(far)):
            dj, k = far[n, 0], far[n, 1]
            there = _row(cells, y + dj, radius + k)
            _below_plane(here, there, out[0, j], out[1, j], k * side, dj * side, out[3, j])


@lru_cache(maxsize=64)
def _geometry(radius: int, side: float, slope: float, step: float) -> tuple[F8, I8, I8]:
    """Return the largest differences of height for `_fit`, and the near and far cells for `_drop`."""
    numbers = np.arange(radius + 1)
    distance = np.sqrt(np.add.outer(numbers**2, numbers**2).astype(np.float64)) * side
    most = np.minimum(np.maximum(step, min(2.0 * tan(slope), FAR) * distance), FAR)
    reachable = distance <= max(NEAR, 1.5 * side) + 1e-9
    close = reachable & (distance <= NEAR + 1e-9)
    rows = range(-radius, radius + 1)
    near = [int(close[abs(dy)].sum()) - 1 for dy in rows]
    far = [(dy, dx) for dy in rows for dx in rows if (reachable & ~close)[abs(dy), abs(dx)]]
    return most, np.array(near, np.int64), np.array(far, np.int64).reshape(-1, 2)


def planes(height: F8, halo: Halo, side: float, slope: float, step: float) -> PlaneLayers:
    """Return the layers of a tile from what is around it.

    ``height`` (64 + 2 r, 64 + 2 r): known ground, infinite elsewhere, r <= 6. ``side``: of a cell, metres. A plane
    leaves out what differs from its centre by more than the limit ``step``, or twice what the limit ``slope`` explains:
    a kerb is a step, not a slope.
    """
    size = height.shape[0]
    radius = (size - TILE_CELLS) // 2
    inner = slice((halo.mean.shape[0] - size) // 2, (halo.mean.shape[0] + size) // 2)
    cells = np.empty((size, VALUES, ROW))
    for number, plane in enumerate(
        (height, *(plane[inner, inner] for plane in (halo.weight, halo.scatter, halo.free)))
    ):
        cells[:, number, :size] = plane
    most, near, far = _geometry(radius, side, slope, step)
    out = np.empty((5, TILE_CELLS, TILE_CELLS))
    room = np.empty((2, SUMS))
    _fit(cells.reshape(-1), side, most, room[0], room[1], out)
    _drop(cells.reshape(-1), radius, side, near, far, room[0, :TILE_CELLS], out)
    return PlaneLayers(*out)
