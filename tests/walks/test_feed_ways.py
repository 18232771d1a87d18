"""A recording, shortened, sent in all ways: nothing is lost, and the maps are equal to the bit."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import walks_paths  # noqa: F401 - before what it makes importable
from feed_ways import QUICK, SLOW, Fed, differences, feed_all, record

from roughmap_schemas.kinds import Kind

SECONDS = 1.2


def test_no_way_of_feeding_loses_anything(tmp_path: Path) -> None:
    recording = record(5, SECONDS)
    ways = feed_all(tmp_path, recording)
    assert len(ways) == len(QUICK) + len(SLOW)
    assert ways[0].clouds > 10
    assert differences(ways) == []


def test_what_is_lost_or_differs_is_found() -> None:
    full = Fed("a", 2, Counter(integrated=2), Counter(), np.ones((1, 2, 2)))
    assert differences([full]) == []
    for other in (
        replace(full, outcomes=Counter(integrated=1, late=1)),
        replace(full, lost=Counter({"poses ahead": 1})),
        replace(full, layers=full.layers * 2),
    ):
        assert len(differences([full, other])) == 1
    assert len(differences([replace(full, layers=full.layers * np.nan)])) == 1


def test_a_recording_has_each_message_once_in_every_way() -> None:
    recording = record(1, 1.0)
    assert recording == record(1, 1.0)
    assert {one.kind for one in recording} == {Kind.POINTS, Kind.ODOMETRY}
    for order in (QUICK | SLOW).values():
        sent = list(order(recording))
        assert sorted(one.at for _, one in sent) == [one.at for one in recording]
        assert [at for at, _ in sent] == sorted(at for at, _ in sent)
