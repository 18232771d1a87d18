"""What was emptied, by resets and because it was forgotten, and how much of it is remembered."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service.answers.emptied_tiles import MOST_PARTS, EmptiedHistory

NOTHING = np.empty((0, 2), np.int32)


def tiles(*x: int) -> np.ndarray:
    return np.array([(one, 0) for one in x], np.int32).reshape(-1, 2)


def emptied(limit: int, *rounds: list[int]) -> EmptiedHistory:
    """Tiles (x, 0), emptied at the sequences 2, 4, 6, ..."""
    known = EmptiedHistory(limit)
    for number, some in enumerate(rounds, 1):
        known.note(tiles(*some), 2 * number)
    return known


def told(known: EmptiedHistory, after: int = -1) -> list[int]:
    return known.now.tiles(0, NOTHING, after)[:, 0].tolist()


def test_nothing_was_emptied() -> None:
    now = EmptiedHistory(100).now
    assert (now.sequence, now.tiles(0, tiles(1)).tolist(), now.tiles(3, NOTHING).shape) == (0, [], (0, 2))


def test_tiles_of_all_changes_are_reported() -> None:
    gone = emptied(100, [1, 2], [2, 3], [5]).now
    assert gone.sequence == 6
    assert gone.tiles(0, NOTHING).tolist() == [[1, 0], [2, 0], [3, 0], [5, 0]]
    assert gone.tiles(0, tiles(2)).tolist() == [[1, 0], [3, 0], [5, 0]]
    assert gone.tiles(1, NOTHING).tolist() == [[0, 0], [1, 0], [2, 0]]


def test_those_of_later_changes_alone() -> None:
    known = emptied(100, [1, 2], [2, 3], [5])
    assert [told(known, after) for after in (2, 5, 6)] == [[2, 3, 5], [5], []]


def test_beyond_the_limit_the_earliest_changes_are_forgotten() -> None:
    assert told(emptied(4, [1, 2], [3], [5])) == [1, 2, 3, 5]
    assert told(emptied(3, [1, 2], [3], [5])) == [3, 5]
    assert told(emptied(1, [1, 2], [3], [5])) == [5]


def test_a_tile_counts_once_against_the_limit() -> None:
    assert told(emptied(3, [1, 2, 3], [1, 2, 3], [3, 2, 1])) == [1, 2, 3]
    assert told(emptied(3, [1, 2], [3], [1, 4])) == [1, 3, 4]


def test_the_last_change_is_always_reported_whole() -> None:
    assert told(emptied(1, [1, 2, 3])) == [1, 2, 3]


@examples(60)
@given(st.lists(st.lists(st.integers(0, 40), min_size=1, unique=True), max_size=4 * MOST_PARTS), st.integers(0, 1000))
def test_no_tile_is_missed_however_many_changes_there_were(rounds: list[list[int]], since: int) -> None:
    """Some may be reported that were emptied a little before, but never one that was not."""
    known = emptied(1000, *rounds)
    assert len(known.now.parts) <= MOST_PARTS
    since = min(since, 2 * len(rounds))
    found = set(told(known, since))
    assert found >= {x for number, some in enumerate(rounds, 1) if 2 * number > since for x in some}
    assert found <= {x for some in rounds for x in some}
