"""What resets emptied, and how much of it is remembered."""

import numpy as np

from roughmap import RoughMap
from roughmap_service.answers.reset_history import ResetHistory

NOTHING = np.empty((0, 2), np.int32)


def emptied(limit: int, *rounds: list[int]) -> ResetHistory:
    """A map of point tiles (x, 0), filled and reset once for each round."""
    rough_map, known = RoughMap(error_model="point", threads=1), ResetHistory(limit)
    for tiles in rounds:
        rough_map.add([[6.4 * x + 1.0, 1.0, 0.0] for x in tiles])
        known.note(rough_map)
        rough_map.reset()
    return known


def test_tiles_of_all_resets_are_reported() -> None:
    gone = emptied(100, [1, 2], [2, 3], [5]).now
    assert gone.sequence == 6
    assert gone.tiles(0, NOTHING).tolist() == [[1, 0], [2, 0], [3, 0], [5, 0]]
    assert gone.tiles(0, np.array([[2, 0]], np.int32)).tolist() == [[1, 0], [3, 0], [5, 0]]
    assert gone.tiles(1, NOTHING).tolist() == [[0, 0], [1, 0], [2, 0]]


def test_those_of_later_resets_alone() -> None:
    """Sequences of the resets: 2, 4, 6; a tile counts with its last one."""
    gone = emptied(100, [1, 2], [2, 3], [5]).now
    assert gone.tiles(0, NOTHING, after=2).tolist() == [[2, 0], [3, 0], [5, 0]]
    assert gone.tiles(0, NOTHING, after=5).tolist() == [[5, 0]]
    assert gone.tiles(0, NOTHING, after=6).tolist() == []


def test_beyond_the_limit_the_earliest_resets_are_forgotten() -> None:
    assert emptied(4, [1, 2], [3], [5]).now.level0[:, 0].tolist() == [1, 2, 3, 5]
    assert emptied(3, [1, 2], [3], [5]).now.level0[:, 0].tolist() == [3, 5]
    assert emptied(1, [1, 2], [3], [5]).now.level0[:, 0].tolist() == [5]


def test_a_tile_counts_once_with_the_last_reset_that_emptied_it() -> None:
    assert emptied(3, [1, 2, 3], [1, 2, 3], [3, 2, 1]).now.level0[:, 0].tolist() == [1, 2, 3]
    assert emptied(3, [1, 2], [3], [1, 4]).now.level0[:, 0].tolist() == [1, 3, 4]


def test_the_last_reset_is_always_reported_whole() -> None:
    assert emptied(1, [1, 2, 3]).now.level0[:, 0].tolist() == [1, 2, 3]
