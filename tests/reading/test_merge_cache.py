"""The cache of merged and read tiles: its limit, and what goes first."""

import numpy as np

from roughmap.cell import CELL_DTYPE
from roughmap.reading.merge_cache import MergeCache


def test_the_cache_is_bounded() -> None:
    cache = MergeCache(limit=3 * 4096 * 64)
    made: list[int] = []

    def make(n: int) -> np.ndarray:
        made.append(n)
        return np.zeros(4096, CELL_DTYPE)

    for n in (0, 1, 2, 0, 3, 0, 1):
        cache.get((n,), lambda n=n: make(n))
        assert cache.nbytes <= cache.limit
    # 1 was the least recently used when 3 was added, then 2 when 1 was added again
    assert made == [0, 1, 2, 3, 1]


def test_lower_levels_do_not_evict_the_level_that_is_read() -> None:
    cache = MergeCache(limit=4 * 4096 * 64)
    made: list[int] = []

    def get(n: int, *, lower: bool = False) -> None:
        cache.get((n,), lambda: made.append(n) or np.zeros(4096, CELL_DTYPE), lower=lower)  # type: ignore[func-returns-value]
        assert cache.nbytes <= cache.limit

    for n in range(10, 14):
        get(n, lower=True)
    for n in (13, 0, 1, 10, 11, 0, 1):  # lower levels may use the whole cache while there is nothing else
        get(n, lower=n > 1)
    assert made == [10, 11, 12, 13, 0, 1, 10, 11]
    for n in (2, 3, 4):  # the least recently used entries of the level go when lower ones take less than half
        get(n)
    for n in (10, 11):
        get(n, lower=True)
    assert made == [10, 11, 12, 13, 0, 1, 10, 11, 2, 3, 4]


def test_an_array_larger_than_the_cache_is_not_kept() -> None:
    cache = MergeCache(limit=10)
    assert cache.get((1,), lambda: np.zeros(11, np.uint8)).size == 11
    assert cache.nbytes == 0
