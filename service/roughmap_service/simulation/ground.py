"""Synthetic ground of known height: slopes, waves, rocks, a ditch and a wall.

The ground is the bilinear interpolation of a seeded grid, repeated without a seam every `PERIOD` metres. The scanner's
rays and checks of a map use this same function, at any extent.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.jit import inline, kernel

SPACING = 0.05
"""Metres between grid nodes: half a default cell, so that the ground has some shape within a cell."""

NODES = 2048
"""Nodes per side: a power of two, so that indices wrap by a mask."""

PERIOD = SPACING * NODES

BLOCK = 16
"""Nodes per side of a block. A ray skips the blocks whose highest point it passes above."""

PATH_HALF_LENGTH, PATH_HALF_WIDTH = 11.0, 6.0
"""The figure of eight that rovers drive, in metres from its centre. Tall rocks and the wall are beside it."""

Floats = npt.NDArray[np.float64]


def path(s: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Return the figure of eight at angle `s` (radians, period 2 pi): x and y in metres."""
    angle = np.asarray(s, dtype=np.float64)
    return PATH_HALF_LENGTH * np.sin(angle), PATH_HALF_WIDTH * np.sin(2 * angle)


class Ground:
    """The ground of one seed. `grid` (NODES, NODES) holds heights in metres, [row = y, column = x]."""

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng([seed, 0x6707])
        self.grid = _waves(rng)
        _add_ditch(self.grid)
        _add_rocks(self.grid, rng)
        _add_wall(self.grid)
        self.block_top = _block_top(self.grid)
        self.top = float(self.grid.max())

    def height(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
        """Return the true height in metres at map positions `x`, `y` (shapes that broadcast)."""
        xs, ys = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        out = np.empty(xs.size)
        _heights(self.grid, xs.ravel(), ys.ravel(), out)
        return out.reshape(xs.shape)


@inline
def height_at(grid: Any, x: float, y: float) -> float:
    """Return the ground's height at one point, bilinear between the four nodes around it."""
    u = x / SPACING
    v = y / SPACING
    i = np.floor(u)
    j = np.floor(v)
    fx = u - i
    fy = v - j
    i0 = np.int64(i) & (NODES - 1)
    j0 = np.int64(j) & (NODES - 1)
    i1 = (i0 + 1) & (NODES - 1)
    j1 = (j0 + 1) & (NODES - 1)
    low = grid[j0, i0] + fx * (grid[j0, i1] - grid[j0, i0])
    high = grid[j1, i0] + fx * (grid[j1, i1] - grid[j1, i0])
    height: float = low + fy * (high - low)
    return height


@kernel
def _heights(grid: Any, x: Any, y: Any, out: Any) -> None:
    for k in range(x.size):
        out[k] = height_at(grid, x[k], y[k])


def _nodes() -> Floats:
    """Return the node coordinates in metres in the order of the grid: from 0 up, then the negative half."""
    index = np.arange(NODES)
    return np.where(index < NODES // 2, index, index - NODES) * SPACING


def _waves(rng: np.random.Generator) -> Floats:
    """Return slopes and undulation: waves whose lengths divide the period; longer ones are higher."""
    grid = np.zeros((NODES, NODES))
    node = _nodes()
    for length, amplitude, count in ((51.2, 0.9, 3), (17.0, 0.25, 4), (5.1, 0.05, 6), (1.3, 0.012, 8)):
        for _ in range(count):
            turn = rng.uniform(0, 2 * np.pi)
            kx = round(PERIOD / length * np.cos(turn)) * 2 * np.pi / PERIOD
            ky = round(PERIOD / length * np.sin(turn)) * 2 * np.pi / PERIOD
            size = amplitude * rng.uniform(0.4, 1.0)
            # exp(i(kx x + ky y)) is an outer product, so no (NODES, NODES) array of angles is needed.
            wave = np.outer(np.exp(1j * ky * node), size * np.exp(1j * (kx * node + rng.uniform(0, 2 * np.pi))))
            grid += wave.real
    return grid


def _add_ditch(grid: Floats) -> None:
    """Add a ditch across the western loop of the path, 1.6 m wide and 0.35 m deep, with smooth banks."""
    node = _nodes()
    x, y = node[None, :], node[:, None]
    across = np.abs(x + 7.0 + 0.25 * y)
    along = np.clip((14.0 - np.abs(y)) / 2.0, 0, 1)
    inside = across < 0.8
    grid -= np.where(inside, 0.35 * 0.5 * (1 + np.cos(np.pi * across / 0.8)), 0.0) * along


def _add_wall(grid: Floats) -> None:
    """Add a wall north of the path, 0.4 m thick and 1.5 m above the ground; its sides are one node wide."""
    node = _nodes()
    rows = np.nonzero((node >= 8.6) & (node <= 9.0))[0]
    columns = np.nonzero((node >= -6.0) & (node <= 7.0))[0]
    grid[np.ix_(rows, columns)] += 1.5


def _add_rocks(grid: Floats, rng: np.random.Generator) -> None:
    """Add rounded rocks of 0.15 to 0.7 m radius; those on the path are low enough to drive over."""
    px, py = path(np.linspace(0, 2 * np.pi, 400, endpoint=False))
    node = np.arange(NODES)
    for _ in range(420):
        x, y = rng.uniform(-22.0, 22.0, 2)
        radius = rng.uniform(0.15, 0.7)
        height = radius * rng.uniform(0.5, 1.1)
        squash, turn = rng.uniform(0.6, 1.0), rng.uniform(0, np.pi)
        if np.min(np.hypot(px - x, py - y)) < 1.0 + radius:
            height = min(height, 0.08)
        reach = int(radius / SPACING) + 2
        i, j = int(np.floor(x / SPACING)), int(np.floor(y / SPACING))
        columns, rows = np.arange(i - reach, i + reach + 1), np.arange(j - reach, j + reach + 1)
        dx, dy = columns[None, :] * SPACING - x, rows[:, None] * SPACING - y
        u = dx * np.cos(turn) + dy * np.sin(turn)
        v = (dy * np.cos(turn) - dx * np.sin(turn)) / squash
        bump = height * np.sqrt(np.clip(1 - (u**2 + v**2) / radius**2, 0, 1))
        grid[np.ix_(node[rows % NODES], node[columns % NODES])] += bump


def _block_top(grid: Floats) -> Floats:
    """Return the highest node of each block and its upper and right border; between nodes the ground is not higher."""
    wrapped = np.pad(grid, ((0, 1), (0, 1)), mode="wrap")
    count = NODES // BLOCK
    top = np.full((count, count), -np.inf)
    for dj in range(BLOCK + 1):
        for di in range(BLOCK + 1):
            rows = slice(dj, dj + (count - 1) * BLOCK + 1, BLOCK)
            columns = slice(di, di + (count - 1) * BLOCK + 1, BLOCK)
            np.maximum(top, wrapped[rows, columns], out=top)
    return top
