"""Synthetic ground of known height: slopes, waves, rocks, ditches, a wall, and a yard with a kerb.

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

Box = tuple[float, float, float, float]
"""Metres: least x, least y, greatest x, greatest y."""

YARD: Box = (2.0, -10.0, 19.0, 8.0)
"""The eastern loop lies in a yard: almost level, so that what is built there stands upright. The west is wild."""

YARD_BORDER = 9.0
"""Metres over which wild ground becomes the yard's."""

BUILT: tuple[Box, ...] = (
    (4.0, 3.0, 10.0, 8.2),
    (4.0, -7.8, 10.5, -3.2),
    (7.0, -2.0, 15.0, 2.0),
    (-0.5, 5.5, 3.5, 8.2),
    (-4.5, -9.0, 2.5, -8.0),
    (-14.0, -9.8, -8.2, -7.4),
)
"""No rocks here: roof, tunnel, bridge, puddle, glass and trench."""

PUDDLE = (1.5, 7.0, 1.1, 0.7)
"""Centre and half axes of a puddle before the wall, metres."""

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
        _add_kerb(self.grid)
        _add_trench(self.grid)
        _level_puddle(self.grid)
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
    """Return slopes and undulation: waves whose lengths divide the period; longer ones are higher.

    In the yard the long waves give way to a plane through them, half as steep.
    """
    long, short = np.zeros((NODES, NODES)), np.zeros((NODES, NODES))
    node = _nodes()
    for length, amplitude, count in ((51.2, 0.9, 3), (17.0, 0.25, 4), (5.1, 0.05, 6), (1.3, 0.012, 8)):
        for _ in range(count):
            turn = rng.uniform(0, 2 * np.pi)
            kx = round(PERIOD / length * np.cos(turn)) * 2 * np.pi / PERIOD
            ky = round(PERIOD / length * np.sin(turn)) * 2 * np.pi / PERIOD
            size = amplitude * rng.uniform(0.4, 1.0)
            # exp(i(kx x + ky y)) is an outer product, so no (NODES, NODES) array of angles is needed.
            wave = np.outer(np.exp(1j * ky * node), size * np.exp(1j * (kx * node + rng.uniform(0, 2 * np.pi))))
            into = long if length > 10 else short
            into += wave.real
    inside = (_distance(YARD) == 0).nonzero()
    x, y = node[inside[1]], node[inside[0]]
    (along_x, along_y, height), *_ = np.linalg.lstsq(np.stack([x, y, np.ones(x.size)], -1), long[inside], rcond=None)
    middle = x.mean(), y.mean()
    plane = height + along_x * (node[None, :] + middle[0]) / 2 + along_y * (node[:, None] + middle[1]) / 2
    wild = np.clip(_distance(YARD) / YARD_BORDER, 0, 1)
    wild *= wild * (3 - 2 * wild)
    return np.asarray(plane + wild * (long - plane) + (0.4 + 0.6 * wild) * short, dtype=np.float64)


def _distance(box: Box) -> Floats:
    """Return each node's distance from a box in metres, 0 inside."""
    node = _nodes()
    aside_x = np.maximum(np.maximum(box[0] - node, node - box[2]), 0)
    aside_y = np.maximum(np.maximum(box[1] - node, node - box[3]), 0)
    distance: Floats = np.hypot(aside_x[None, :], aside_y[:, None])
    return distance


def _add_ditch(grid: Floats) -> None:
    """Add a ditch across the western loop of the path, 2.6 m wide and 0.25 m deep: its banks can be driven."""
    node = _nodes()
    x, y = node[None, :], node[:, None]
    across = np.abs(x + 7.0 + 0.25 * y)
    along = np.clip((14.0 - np.abs(y)) / 2.0, 0, 1)
    inside = across < 1.3
    grid -= np.where(inside, 0.25 * 0.5 * (1 + np.cos(np.pi * across / 1.3)), 0.0) * along


def _add_wall(grid: Floats) -> None:
    """Add a wall north of the path, 0.4 m thick and 1.5 m above the ground; its sides are one node wide."""
    _raise(grid, (-6.0, 8.6, 7.0, 9.0), 1.5)


def _add_kerb(grid: Floats) -> None:
    """Add a pavement in the east of the yard: its kerb is 12 cm high in the south, 25 cm in the north."""
    _raise(grid, (15.0, -9.0, 18.5, 0.0), 0.12)
    _raise(grid, (15.0, 0.05, 18.5, 9.0), 0.25)


def _add_trench(grid: Floats) -> None:
    """Add a trench beside the south-western bend, 0.8 m wide and 0.6 m deep, with upright sides."""
    _raise(grid, (-13.0, -9.0, -9.0, -8.2), -0.6)


def _level_puddle(grid: Floats) -> None:
    """Make the ground flat where the puddle is: a mirror of uneven water would be none."""
    node = _nodes()
    x, y, half_x, half_y = PUDDLE
    out = np.hypot((node[None, :] - x) / half_x, (node[:, None] - y) / half_y)
    flat = np.clip((1.5 - out) / 0.4, 0, 1)  # up to a tenth beyond the water
    grid += flat * (grid[out <= 1].mean() - grid)


def _raise(grid: Floats, box: Box, height: float) -> None:
    node = _nodes()
    rows = np.nonzero((node >= box[1]) & (node <= box[3]))[0]
    columns = np.nonzero((node >= box[0]) & (node <= box[2]))[0]
    grid[np.ix_(rows, columns)] += height


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
        if any(box[0] < x < box[2] and box[1] < y < box[3] for box in BUILT):
            continue
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
