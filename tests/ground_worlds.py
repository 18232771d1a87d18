"""States of a made-up map of the ground: slopes, kerbs, holes, roofs, strays, and columns of many kinds."""

import numpy as np

from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, SUPPORTED, TILE_CELLS, TRUST_DTYPE
from roughmap.map import RoughMap
from roughmap.tiles.state import TileState

Tiles = dict[tuple[int, int], TileState]


def world(
    seed: int, shape: tuple[int, int], side: float, *, holes: float = 0.2, objects: float = 0.1, steep: float = 0.3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cells, trust and columns (ny, nx) of a piece of ground. ``objects``: part of the cells with a column."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] * side
    gx, gy = rng.uniform(-steep, steep, 2)
    height = 300.0 * rng.integers(-1, 2) + gx * x + gy * y + 0.3 * np.sin(x / side / 9) + rng.normal(0.0, 0.02, shape)
    height += 0.35 * (rng.uniform(size=2)[0] * shape[1] * side < x)  # a kerb
    for _ in range(4):  # roofs, decks
        j, i = (rng.integers(0, n) for n in shape)
        height[j : j + rng.integers(2, 15), i : i + rng.integers(2, 15)] += rng.choice([0.4, 1.5, 2.6, 4.0])
    cells = np.zeros(shape, CELL_DTYPE)
    count = np.where(rng.uniform(size=shape) < 0.5, 1, rng.integers(1, 60, shape))
    cells["count"], cells["updated"] = count, rng.integers(0, 100, shape)
    cells["weight"] = count * rng.uniform(0.5, 200.0, shape)
    cells["weight_sq"] = cells["weight"] ** 2 / (count * rng.uniform(0.3, 1.0, shape))
    strays = rng.uniform(size=shape) < 0.03
    cells["mean"] = height + strays * rng.normal(0.0, 2.0, shape)
    cells["m2"] = cells["weight"] * rng.uniform(0.0, 1.0, shape) ** 4 * 4e-3 * (count > 1)
    cells["min"], cells["max"] = cells["mean"] - 0.05, cells["mean"] + 0.05
    cells["inv_cf"] = cells["weight"] * 1e3
    trust = np.zeros(shape, TRUST_DTYPE)
    trust["variance"] = rng.uniform(0.0, 4e-4, shape) * (rng.uniform(size=shape) < 0.7)
    trust["pose_variance"] = trust["variance"] * rng.uniform(0.9, 3.0, shape)
    trust["mount_sigma"] = rng.uniform(0.0, 0.02, shape)
    columns = np.zeros(shape, COLUMN_DTYPE)
    based = rng.uniform(size=shape) < objects
    columns["flags"] = np.where(based, BASED | (SUPPORTED * rng.integers(0, 2, shape)), 0)
    columns["base"] = np.where(based, np.floor(10.0 * cells["mean"]) - 11 + rng.integers(-2, 3, shape), 0)
    bins = rng.integers(0, 256, (*shape, 40)) * (rng.uniform(size=(*shape, 40)) < rng.choice([0.02, 0.1, 0.6]))
    columns["bins"] = np.where(based[..., None], bins & rng.choice([0x11, 0x33, 0xFF], (*shape, 1)), 0)
    unknown = rng.uniform(size=shape) < holes
    for array in (cells, trust, columns):
        array[unknown] = np.zeros((), array.dtype)
    return cells, trust, columns


def cut(arrays: tuple[np.ndarray, np.ndarray, np.ndarray], corner: tuple[int, int]) -> Tiles:
    """Cut ``arrays`` (ny, nx), whose first cell is (i, j) = ``corner``, into tiles; cells beyond are unknown."""
    ny, nx = arrays[0].shape
    i0, j0 = corner
    tiles: Tiles = {}
    for y in range(j0 // TILE_CELLS, (j0 + ny - 1) // TILE_CELLS + 1):
        for x in range(i0 // TILE_CELLS, (i0 + nx - 1) // TILE_CELLS + 1):
            j, i = y * TILE_CELLS - j0, x * TILE_CELLS - i0
            rows, columns = slice(max(j, 0), j + TILE_CELLS), slice(max(i, 0), i + TILE_CELLS)
            made = []
            for array in arrays:
                tile = np.zeros((TILE_CELLS, TILE_CELLS), array.dtype)
                part = array[rows, columns]
                below, left = max(-j, 0), max(-i, 0)
                tile[below : below + part.shape[0], left : left + part.shape[1]] = part
                made.append(tile.reshape(-1))
            cells, trust, column = made
            if cells["count"].any():
                tiles[x, y] = TileState(cells, trust, column if (column["flags"] & BASED).any() else None)
    return tiles


def loaded(tiles: Tiles, side: float, surface: str = "ground", levels: int = 4) -> RoughMap:
    """Return a map of these tiles."""
    m = RoughMap(cell_size=side, error_model="point", surface=surface, levels=levels, threads=1)
    for (x, y), state in tiles.items():
        m.load_tile(x, y, state, 0, 99 * 10**9)
    return m
