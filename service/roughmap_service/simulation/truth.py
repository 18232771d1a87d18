"""What a perfect map of the simulated world would say of each cell at a time: height, passable or not, and why not.

A cell's height is the mean of the true ground in it. The rules are those of traversability with a map's default limits,
on true heights: a cell is impassable for what stands or hangs between the height of a step and the robot's own over it;
for a drop of more than a step within 0.3 m; for the slope of the plane through the ground within 0.3 m, and for the
ground's scatter about that plane.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from roughmap_service.simulation.solids import extent
from roughmap_service.simulation.world import World

SLOPE, STEP, ROUGHNESS, CLEARANCE = 0.5, 0.2, 0.1, 2.0
"""What the robot can pass: radians, then metres."""

NEAR = 0.3
"""Metres around a cell's centre whose ground a wheel there may touch."""

SAMPLES = 5
"""Heights along a cell's side."""

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class Why(IntEnum):
    """Why a cell can't be passed: the first of these that holds."""

    PASSABLE = 0
    OBJECT = 1
    STEP = 2
    SLOPE = 3
    ROUGH = 4


@dataclass(frozen=True)
class Truth:
    """The truth of cells, rows along y and columns along x.

    `height` in metres, NaN where a solid stands: what is the ground there? `soft` marks what hides the ground, but lets
    a robot through: tall grass.
    """

    height: Floats
    why: npt.NDArray[np.int8]
    soft: Flags

    @property
    def passable(self) -> Flags:
        """Return where a robot can be."""
        return np.asarray(self.why == Why.PASSABLE)


def truth(world: World, seconds: float, origin: tuple[float, float], cell_size: float, shape: tuple[int, int]) -> Truth:
    """Return the truth of `shape` cells from the lower-left corner `origin` on, `seconds` after the start."""
    halo = int(np.ceil(NEAR / cell_size))
    rows, columns = shape[0] + 2 * halo, shape[1] + 2 * halo
    x = origin[0] + (np.arange(columns * SAMPLES) + 0.5) * cell_size / SAMPLES - halo * cell_size
    y = origin[1] + (np.arange(rows * SAMPLES) + 0.5) * cell_size / SAMPLES - halo * cell_size
    fine = world.ground.height(x[None, :], y[:, None]).reshape(rows, SAMPLES, columns, SAMPLES)
    mean = fine.mean((1, 3))
    inner = slice(halo, rows - halo), slice(halo, columns - halo)
    slope, residual, drop = _terrain(mean, cell_size, halo)
    rough = np.sqrt(residual + np.maximum(fine.var((1, 3))[inner] - np.tan(slope) ** 2 * cell_size**2 / 12, 0))
    height = mean[inner]
    standing, hit, soft = _objects(world, seconds, origin, cell_size, height)
    why = np.select(
        [hit, drop > STEP, slope > SLOPE, rough > ROUGHNESS],
        [Why.OBJECT, Why.STEP, Why.SLOPE, Why.ROUGH],
        Why.PASSABLE,
    )
    return Truth(np.where(standing, np.nan, height), why.astype(np.int8), soft)


def _terrain(mean: Floats, cell_size: float, halo: int) -> tuple[Floats, Floats, Floats]:
    """Return slope (radians), mean square about the plane (m2) and largest drop (m), without the halo.

    The plane leaves out what stands or falls away steeply: that is a step, not a slope.
    """
    rows, columns = mean.shape[0] - 2 * halo, mean.shape[1] - 2 * halo
    here = mean[halo : halo + rows, halo : halo + columns]
    drop = np.zeros(here.shape)
    sums = np.zeros((10, *here.shape))
    for j in range(-halo, halo + 1):
        for i in range(-halo, halo + 1):
            dx, dy = i * cell_size, j * cell_size
            distance = np.hypot(dx, dy)
            if distance > NEAR + 1e-9:  # 3 * 0.1 is a little more than 0.3
                continue
            dz = mean[halo + j : halo + j + rows, halo + i : halo + i + columns] - here
            np.maximum(drop, -dz, out=drop)
            part = (np.abs(dz) <= max(STEP, 2 * np.tan(SLOPE) * distance)).astype(np.float64)
            for k, term in enumerate((1.0, dx, dy, dz, dx * dx, dx * dy, dy * dy, dx * dz, dy * dz, dz * dz)):
                sums[k] += part * term
    n, x, y, z, xx, xy, yy, xz, yz, zz = sums
    cxx, cxy, cyy = xx / n - (x / n) ** 2, xy / n - x * y / n**2, yy / n - (y / n) ** 2
    cxz, cyz, czz = xz / n - x * z / n**2, yz / n - y * z / n**2, zz / n - (z / n) ** 2
    determinant = cxx * cyy - cxy**2
    plane = determinant > 1e-3 * (cxx + cyy) ** 2  # else all cells are in one line, and there is no plane
    safe = np.where(plane, determinant, 1.0)
    gx = np.where(plane, (cxz * cyy - cyz * cxy) / safe, 0.0)
    gy = np.where(plane, (cyz * cxx - cxz * cxy) / safe, 0.0)
    return np.arctan(np.hypot(gx, gy)), np.maximum(czz - gx * cxz - gy * cyz, 0.0), drop


def _objects(
    world: World, seconds: float, origin: tuple[float, float], cell_size: float, height: Floats
) -> tuple[Flags, Flags, Flags]:
    """Return the cells where a solid stands, those where one is in a robot's way, and those with soft ones."""
    standing, hit, soft = (np.zeros(height.shape, dtype=np.bool_) for _ in range(3))
    left = origin[0] + np.arange(height.shape[1]) * cell_size
    low = origin[1] + np.arange(height.shape[0]) * cell_size
    solids = world.solids(seconds)
    for k, one in enumerate(solids):
        # Solids are convex: if one is over a cell at all, it is so at the cell's nearest point to its centre.
        dx = np.clip(one["x"], left, left + cell_size) - one["x"]
        dy = np.clip(one["y"], low, low + cell_size) - one["y"]
        columns, rows = np.nonzero(np.abs(dx) <= one["half_x"])[0], np.nonzero(np.abs(dy) <= one["half_y"])[0]
        box = np.ix_(rows, columns)
        bottom, top = extent(solids, k, dx[columns][None, :], dy[rows][:, None])
        if one["soft"]:
            soft[box] |= top > height[box]
            continue
        over = (top > height[box] + STEP) & (bottom < height[box] + CLEARANCE)
        hit[box] |= over
        standing[box] |= over & (bottom < height[box] + STEP)
    return standing, hit, soft
