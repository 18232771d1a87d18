"""Cells made by hand or at random for the tests of the read path."""

from collections.abc import Iterable

import numpy as np

from roughmap.cell import CELL_DTYPE, TILE_CELLS, TRUST_DTYPE
from roughmap.tiles.state import TileState

TILE_SHAPE = (TILE_CELLS, TILE_CELLS)


def cell_of(heights: Iterable[float], weights: Iterable[float] | None = None, updated: int = 0) -> np.ndarray:
    """Return the record of a cell with whole points (p = 1) of these heights and weights, from the definitions."""
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


def state_of(records: np.ndarray) -> TileState:
    """Return the state of a tile whose points have no errors in common."""
    return TileState(records.reshape(-1), np.zeros(TILE_CELLS * TILE_CELLS, TRUST_DTYPE), None)


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
