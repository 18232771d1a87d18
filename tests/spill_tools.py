"""A map whose tiles leave memory for a file, and its content."""

import numpy as np

from roughmap import RoughMap
from roughmap_service.store.spill import Spill

S = np.diag([0.03, 0.03, 0.02]) ** 2
FAR = [[1001.0, 1.0, 0.0]]


def ground(seed: int, number: int = 600, reach: float = 18.0) -> np.ndarray:
    """Return points (number, 3) on a slope with bumps, over up to 6 x 6 tiles."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-reach, reach, (2, number))
    return np.column_stack([x, y, 0.1 * x + 0.2 * np.sin(y) + rng.normal(0, 0.02, number)])


def filled(spill: Spill | None = None) -> RoughMap:
    rough_map = RoughMap(levels=4, threads=1, shelf=spill)
    for seed in range(3):
        rough_map.add(ground(seed), S, (5 + seed) * 10**9)
    return rough_map


def leave(rough_map: RoughMap, number: int | None = None) -> int:
    """Move tiles out of memory (None: all but those that the last call needed); return how many left."""
    before = rough_map.resident_tiles
    if number is None:
        table = rough_map._table
        needed = table.used[: table.size] == rough_map.sequence
        number = before - int(np.count_nonzero(needed & (table.slot[: table.size] >= 0)))
    eviction = rough_map.spill(number)
    try:
        eviction.write()
    finally:
        eviction.close()
    return before - rough_map.resident_tiles


def leave_all(rough_map: RoughMap) -> None:
    """Move all tiles out of memory but a far one, which this call adds."""
    rough_map.add(FAR, S, 10**9)
    leave(rough_map)
    assert rough_map.resident_tiles == 1


def tiles_of(rough_map: RoughMap, level: int = 0) -> dict[tuple[int, int], tuple[bytes, int, tuple[int, int]]]:
    """Return the records, sequence and stamps of each tile."""
    with rough_map.freeze(level) as frozen:
        return {
            (x, y): (frozen.records(x, y).tobytes(), int(sequence), frozen.stamps(x, y))
            for (x, y), sequence in zip(frozen.tiles.tolist(), frozen.sequences, strict=True)
        }
