"""Counters read while they go on."""

import time
from typing import Any

from roughmap_service.host.counters import Counters, Counts, Durations


def plain(counts: Counts) -> dict[str, Any]:
    """The counts as plain values."""

    def of(value: Any) -> Any:
        if isinstance(value, Durations):
            return list(value.counts), value.total
        return {key: of(one) for key, one in value.items()} if isinstance(value, dict) else value

    return {name: of(value) for name, value in vars(counts).items()}


def count_all(counters: Counters) -> None:
    now = time.monotonic()
    counters.cloud("integrated", 100, {"range": 2}, now, 0.01)
    counters.cloud("no_pose", 0, {}, now)
    counters.pose(None)
    counters.pose("stale")
    counters.refuse("busy", "rover")
    counters.gap("rover", 3)
    counters.jump("rover")
    counters.forgotten(4)
    counters.output_dropped("queries")
    counters.query("ok", 0.1)
    counters.query("busy", 0.1)
    counters.log_synced(0.01)


def test_a_copy_stays_as_it_was() -> None:
    counters = Counters()
    empty = plain(counters.snapshot())
    count_all(counters)
    copied = counters.snapshot()
    before = plain(copied)
    assert all(before[name] != empty[name] for name in empty), "all of them were counted"
    count_all(counters)
    assert plain(copied) == before
    twice = plain(counters.snapshot())
    assert all(twice[name] != before[name] for name in before)
    assert twice["clouds_rejected"] == {"no_pose": 2}
    assert counters.rates() == (0.2, 20.0, 0.2)
