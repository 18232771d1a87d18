"""A recording, shortened, sent in all ways: nothing is lost, and the maps are equal to the bit."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import walks_paths  # noqa: F401 - before what it makes importable
from feed_ways import QUICK, SLOW, Fed, differences, feed, record

SECONDS = 1.5


def test_no_way_of_feeding_loses_anything(tmp_path: Path) -> None:
    recording = record(5, SECONDS)
    with ThreadPoolExecutor(2) as pool:
        slow = pool.submit(feed, tmp_path / "slow", recording, SLOW)
        quick = pool.submit(feed, tmp_path / "quick", recording, QUICK)
        ways = quick.result() + slow.result()
    assert len(ways) == len(QUICK) + len(SLOW)
    assert ways[0].clouds > 10
    assert differences(ways) == []


def test_what_is_lost_or_differs_is_found() -> None:
    full = Fed("a", 2, {"integrated": 2}, {}, np.ones((1, 2, 2)))
    assert differences([full]) == []
    assert len(differences([full, Fed("b", 2, {"integrated": 1, "late": 1}, {}, full.layers)])) == 1
    assert len(differences([full, Fed("b", 2, full.outcomes, {"poses ahead": 1}, full.layers)])) == 1
    assert len(differences([full, Fed("b", 2, full.outcomes, {}, full.layers * 2)])) == 1
    assert len(differences([Fed("b", 2, full.outcomes, {}, full.layers * np.nan)])) == 1
