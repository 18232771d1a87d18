"""Compare two maps layer by layer, for `replay --what-if`."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap import RoughMap
from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.reading.frozen import FrozenMap
from roughmap.reading.layers import layers_of

SKIPPED = ("age",)
"""Layers of time, which no setting changes."""

ZERO_IS_UNKNOWN = ("count", "weight")
"""Layers that are 0, not NaN, in unknown cells."""


@dataclass(frozen=True, slots=True)
class LayerDifference:
    """How a layer differs between two maps, over the ``cells`` known in both; in the layer's unit."""

    layer: str
    cells: int
    only_before: int
    only_now: int
    median_before: float
    median_now: float
    median_change: float
    p95_abs_change: float


Arrays = dict[str, npt.NDArray[np.float64]]


def compare(before: RoughMap, now: RoughMap) -> list[LayerDifference]:
    """Return the difference of each layer that both have, at the cell centres of the map with the larger cells."""
    both = set(layers_of(before.settings.surface)) & set(layers_of(now.settings.surface))
    names = [name for name in layers_of("ground") if name in both and name not in SKIPPED]
    pairs: dict[str, list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]] = {name: [] for name in names}
    for ours, theirs in _blocks(before, now, names):
        for name in names:
            a, b = ours[name], theirs[name]
            known = _known(name, a) | _known(name, b)
            pairs[name].append((a[known], b[known]))
    return [_difference(name, pairs[name]) for name in names]


def _known(name: str, values: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    known = np.isfinite(values)
    return known & (values != 0) if name in ZERO_IS_UNKNOWN else known


def _blocks(before: RoughMap, now: RoughMap, names: list[str]) -> Iterator[tuple[Arrays, Arrays]]:
    """Yield both maps' layers at the same places, one tile of the coarser map at a time."""
    coarse, fine = (before, now) if before.cell_size >= now.cell_size else (now, before)
    side = coarse.cell_size
    with coarse.freeze() as held, fine.freeze() as finer:
        # A tile of the finer map is not larger than one of the coarser map, but may lie across its edge.
        corners = [
            (finer.tiles + corner) * (fine.cell_size / side) - np.array(corner) * 1e-9
            for corner in ((0, 0), (0, 1), (1, 0), (1, 1))
        ]
        tiles = np.unique(
            np.concatenate([held.tiles, *(np.floor(places).astype(np.int64) for places in corners)]), axis=0
        )
        known = set(map(tuple, finer.tiles.tolist()))
        for tx, ty in tiles.tolist():
            mine = held.tile_layers(tx, ty, names)
            sampled = _sampled(finer, known, names, _cells(tx, side, fine), _cells(ty, side, fine))
            yield (mine, sampled) if coarse is before else (sampled, mine)


def _cells(tile: int, side: float, fine: RoughMap) -> npt.NDArray[np.int64]:
    """Return the finer map's cells (64,), along one axis, at the cell centres of a coarser tile."""
    centres = (tile * TILE_CELLS + np.arange(TILE_CELLS) + 0.5) * side
    # If one cell size is twice the other, centres lie on borders: 1e-9 puts all of them on the same side.
    cells: npt.NDArray[np.int64] = np.floor(centres / fine.cell_size + 1e-9).astype(np.int64)
    return cells


def _sampled(
    finer: FrozenMap,
    known: set[tuple[int, ...]],
    names: list[str],
    columns: npt.NDArray[np.int64],
    rows: npt.NDArray[np.int64],
) -> Arrays:
    """Return the finer map's layers in these cells; reads only ``known`` tiles, one at a time."""
    out = {name: np.full((len(rows), len(columns)), np.nan) for name in names}
    tile_columns, tile_rows = columns >> TILE_SHIFT, rows >> TILE_SHIFT
    for x in np.unique(tile_columns).tolist():
        for y in np.unique(tile_rows).tolist():
            if (x, y) not in known:
                continue
            found = finer.tile_layers(x, y, names)
            i, j = np.flatnonzero(tile_columns == x), np.flatnonzero(tile_rows == y)
            within = np.ix_(rows[j] & (TILE_CELLS - 1), columns[i] & (TILE_CELLS - 1))
            for name in names:
                out[name][np.ix_(j, i)] = found[name][within]
    return out


def _difference(name: str, pairs: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]) -> LayerDifference:
    a = np.concatenate([pair[0] for pair in pairs]) if pairs else np.empty(0)
    b = np.concatenate([pair[1] for pair in pairs]) if pairs else np.empty(0)
    known_a, known_b = _known(name, a), _known(name, b)
    both = known_a & known_b
    change = b[both] - a[both]

    def median(values: npt.NDArray[np.float64]) -> float:
        return float(np.median(values)) if len(values) else float("nan")

    return LayerDifference(
        name,
        int(both.sum()),
        int((known_a & ~known_b).sum()),
        int((known_b & ~known_a).sum()),
        median(a[both]),
        median(b[both]),
        median(change),
        float(np.percentile(np.abs(change), 95)) if len(change) else float("nan"),
    )
