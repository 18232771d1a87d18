"""Cells made by hand or at random for the tests of the read path, and maps read cell by cell."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from roughmap.cell import CELL_DTYPE, TILE_CELLS

TILE_SHAPE = (TILE_CELLS, TILE_CELLS)


def cell_of(heights: Iterable[float], weights: Iterable[float] | None = None, updated: int = 0) -> np.ndarray:
    """Return the record of a cell with whole points (p = 1) of these heights and weights, by the definitions."""
    h = np.array(list(heights), dtype=np.float64)
    w = np.ones(len(h)) if weights is None else np.array(list(weights), dtype=np.float64)
    record = np.zeros((), dtype=CELL_DTYPE)
    total = w.sum()
    mean = (w * h).sum() / total
    record["count"], record["updated"] = len(h), updated
    record["weight"], record["weight_sq"] = total, (w * w).sum()
    record["mean"], record["m2"] = mean, (w * (h - mean) ** 2).sum()
    record["min"], record["max"] = h.min(), h.max()
    record["inv_cf"] = 1e6 * total
    return record


def tile_of(cells: dict[tuple[int, int], np.ndarray]) -> np.ndarray:
    """Return a tile with these records at (i, j), unknown elsewhere."""
    tile = np.zeros(TILE_SHAPE, dtype=CELL_DTYPE)
    for (i, j), record in cells.items():
        tile[j, i] = record
    return tile


def chance_tile(seed: int, known: float = 0.7) -> np.ndarray:
    """Return a tile of plausible cells, some of them unknown."""
    rng = np.random.default_rng(seed)
    tile = np.zeros(TILE_SHAPE, dtype=CELL_DTYPE)
    tile["count"] = rng.integers(1, 9, TILE_SHAPE)
    tile["updated"] = rng.integers(0, 1000, TILE_SHAPE)
    tile["weight"] = rng.uniform(0.5, 2.0, TILE_SHAPE) * tile["count"]
    tile["weight_sq"] = tile["weight"] * rng.uniform(0.5, 1.0, TILE_SHAPE)
    tile["mean"] = rng.normal(0.0, 0.05, TILE_SHAPE)
    tile["m2"] = tile["weight"] * rng.uniform(0.0, 0.01, TILE_SHAPE) * (tile["count"] > 1)
    tile["min"] = tile["mean"] - rng.uniform(0.0, 0.1, TILE_SHAPE)
    tile["max"] = tile["mean"] + rng.uniform(0.0, 0.1, TILE_SHAPE)
    tile["inv_cf"] = tile["weight"] * rng.uniform(1e3, 1e6, TILE_SHAPE)
    tile[rng.uniform(size=TILE_SHAPE) > known] = np.zeros((), dtype=CELL_DTYPE)
    return tile


def over_cells(m: Any, cells: np.ndarray, names: Iterable[str], **options: Any) -> tuple[dict[str, np.ndarray], int]:
    """Return layers of a map at the cells (M, 2), and the number of known cells in the smallest box around them."""
    (i0, j0), (i1, j1) = cells.min(axis=0), cells.max(axis=0) + 1
    side = m.cell_size * (1 << options.get("level", 0))
    r = m.region((i0 * side, j0 * side, i1 * side, j1 * side), [*names, "count"], **options)
    assert r.shape == (j1 - j0, i1 - i0)
    rows, columns = cells[:, 1] - j0, cells[:, 0] - i0
    return {name: r[name][rows, columns] for name in names}, int(np.count_nonzero(r["count"]))
