"""How two maps differ, layer by layer: what `replay --what-if` tells."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap import RoughMap
from roughmap.layers import LAYERS

SKIPPED = ("age",)
"""Layers that say when, not what: they differ by nothing that a setting changes."""


@dataclass(frozen=True, slots=True)
class LayerDifference:
    """One layer over the places that both maps know; heights in metres, and so on as the layer."""

    layer: str
    cells: int
    only_before: int
    only_now: int
    median_before: float
    median_now: float
    median_change: float
    p95_abs_change: float


def compare(before: RoughMap, now: RoughMap) -> list[LayerDifference]:
    """Every layer of two maps, at the cell centres of the one with the larger cells."""
    names = [name for name in LAYERS if name not in SKIPPED]
    pairs: dict[str, list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]] = {name: [] for name in names}
    for ours, theirs in _blocks(before, now, names):
        for name in names:
            pairs[name].append((ours[name], theirs[name]))
    return [_difference(name, pairs[name]) for name in names]


def _blocks(
    before: RoughMap, now: RoughMap, names: list[str]
) -> Iterator[tuple[dict[str, npt.NDArray[np.float64]], dict[str, npt.NDArray[np.float64]]]]:
    """Both maps' layers at the same places, a tile of the coarser map at a time."""
    coarse, fine = (before, now) if before.cell_size >= now.cell_size else (now, before)
    side = coarse.cell_size
    with coarse.freeze() as held, fine.freeze() as finer:
        # The finer map's tiles are no larger than the coarser one's but may lie over an edge of theirs.
        corners = [
            (finer.tiles + corner) * (fine.cell_size / side) - np.array(corner) * 1e-9
            for corner in ((0, 0), (0, 1), (1, 0), (1, 1))
        ]
        tiles = np.unique(
            np.concatenate([held.tiles, *(np.floor(places).astype(np.int64) for places in corners)]), axis=0
        )
    for tx, ty in tiles.tolist():
        x0, y0 = tx * 64 * side, ty * 64 * side
        box = (x0, y0, x0 + 64 * side, y0 + 64 * side)
        ours = coarse.region(box, names)
        other = fine.region((box[0], box[1], box[2] + fine.cell_size, box[3] + fine.cell_size), names)
        columns = _places(ours.origin[0], side, ours.shape[1], other.origin[0], other.cell_size, other.shape[1])
        rows = _places(ours.origin[1], side, ours.shape[0], other.origin[1], other.cell_size, other.shape[0])
        mine = {name: ours[name] for name in names}
        sampled = {name: other[name][np.ix_(rows, columns)] for name in names}
        yield (mine, sampled) if coarse is before else (sampled, mine)


def _places(
    origin: float, side: float, count: int, other: float, other_side: float, limit: int
) -> npt.NDArray[np.int64]:
    """In which of the other map's cells the centres of these lie."""
    centres = origin + (np.arange(count) + 0.5) * side
    places: npt.NDArray[np.int64] = np.floor((centres - other) / other_side + 1e-9).astype(np.int64)
    return places.clip(0, limit - 1)


def _difference(name: str, pairs: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]) -> LayerDifference:
    a = np.concatenate([pair[0].ravel() for pair in pairs]) if pairs else np.empty(0)
    b = np.concatenate([pair[1].ravel() for pair in pairs]) if pairs else np.empty(0)
    known_a, known_b = np.isfinite(a), np.isfinite(b)
    if name in ("count", "weight"):  # these are 0 where nothing is known
        known_a, known_b = known_a & (a != 0), known_b & (b != 0)
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
