"""A real service whose map is several times its memory limit: it stays within, answers for all, is replayed as equal.

A tile costs its 336 KiB as soon as a point lies in each of its 64 rows, so 64 points make one. Something that stands on
the ground costs its tile 256 KiB more.
"""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from processes import READY_S, T0, Feed, Service, connected, replay, running

from roughmap import RoughMap
from roughmap_schemas import encode_cloud

MIB = 1 << 20
TILE_M = 6.4
LIMIT = 64 * MIB
TILES = 40
"""A cloud's, side by side: 13 MiB, and 5 MiB for what stands on every second one."""

CLOUDS = 25
"""450 MiB in all, seven times the limit."""

SLACK = 64 * MIB
"""The limit is looked at before each cloud and twice a second, so on top may come: one cloud's tiles (18 MiB), answers
in the making (20 MiB for the larger region here), Zenoh's shared memory (two pools of 16 MiB at their first use)."""


def strip(number: int) -> np.ndarray:
    """(N, 3): a row of cells down the middle of each tile of strip ``number``, heights all different."""
    x = (np.repeat(np.arange(TILES), 64) + 0.5) * TILE_M
    y = (np.tile(np.arange(64), TILES) + 0.5) * 0.1 + number * TILE_M
    return np.column_stack([x, y, np.sin(0.7 * x) + 0.01 * y])


def built_up(number: int) -> np.ndarray:
    """(N, 3): strip ``number``, and a metre above it, in every second tile, three cells of something."""
    ground = strip(number)
    on = ground.reshape(TILES, 64, 3)[::2, 30:33].reshape(-1, 3)
    return np.vstack([ground, on + np.array([0.0, 0.0, 1.0])])


def strips() -> list[int]:
    """Ground that is new, and now and then old ground again."""
    order = []
    for number in range(CLOUDS):
        order.append(number)
        if number % 8 == 7:
            order.append(number - 6)
    return order


def resident(service: Service) -> int:
    """Of the service's process, as the system counts it."""
    pages = int(Path(f"/proc/{service.process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def send(feed: Feed, points: np.ndarray, turn: int) -> None:
    """A cloud, handed in and decided."""
    payload = encode_cloud(points, T0 + turn * 10**9, "map")
    receipt = feed.ingest("points", "rover", payload)
    assert feed.decided(receipt.input).outcome == "integrated"


def expected(order: list[int]) -> RoughMap:
    """The same strips in a map of our own."""
    made = RoughMap()
    for turn, number in enumerate(order):
        add(made, number, turn)
    return made


def add(made: RoughMap, number: int, turn: int) -> None:
    """A strip as the service takes it: the points of a placed cloud may all err together."""
    made.add(built_up(number), np.eye(3) * 0.02**2, T0 + turn * 10**9, common=0.02**2)


def same_ground(feed: Feed, made: RoughMap) -> None:
    """What the service says of a region over many strips, near and coarse, is what the other map says, to the bit."""
    ground, objects = ["mean_height", "slope", "count"], ["obstacle_top", "traversability"]
    for box, level, names in (
        ((20.0, -10.0, 60.0, 170.0), 0, ground),
        ((0.0, 0.0, 120.0, 80.0), 2, ground),
        ((20.0, -10.0, 60.0, 50.0), 0, objects),
    ):
        asked = feed.client.region(box, names, level=level, dtype="f8")
        there = made.region(box, names, level)
        for name in names:
            np.testing.assert_array_equal(asked[name], there[name])
            assert np.isfinite(there[name]).any()


def test_a_map_of_seven_times_the_limit(tmp_path: Path) -> None:
    """Fed, asked, killed and started again."""
    settings = {
        "map": {"memory_limit": LIMIT},
        "store": {"path": str(tmp_path / "map.db"), "snapshot_interval": 1.0},
        "query": {"max_region_cells": 4_000_000},
    }
    order = strips()
    made = expected(order)
    with Service(tmp_path, **settings) as service, connected(service) as feed:
        before = resident(service)
        most = 0
        for turn, number in enumerate(order):
            send(feed, built_up(number), turn)
            most = max(most, resident(service) - before)
        same_ground(feed, made)
        most = max(most, resident(service) - before)
        status = feed.client.status()
        assert status.tiles.resident + status.tiles.spilled == CLOUDS * TILES == made.tile_count
        assert status.tiles.spilled > CLOUDS * TILES / 2
        assert most < LIMIT + SLACK, f"{most / MIB:.0f} MiB"
        assert status.memory_bytes < before + LIMIT + SLACK
        assert status.health == "ok"
        spilled = service.log / "tiles.spill"
        assert spilled.stat().st_size > 100 * MIB
        service.kill()
    assert spilled.stat().st_size, "left behind by the kill"
    with running(tmp_path, **settings) as (service, feed):
        assert feed.client.status().tiles.spilled > CLOUDS * TILES / 2
        same_ground(feed, made)
        send(feed, built_up(3), 100)
        add(made, 3, 100)
        same_ground(feed, made)
    assert not spilled.exists()
    code, verdict = replay(service.log)
    assert (code, made.digest() in verdict) == (0, True), verdict


def test_where_no_more_may_be_spilled_no_new_tile_is_taken(tmp_path: Path) -> None:
    """Ground that is known goes on; new ground is refused by its reason, and the replay refuses it too."""
    with running(tmp_path, map={"memory_limit": 24 * MIB, "spill_limit": 8 * MIB}) as (_, feed):
        outcomes = []
        for turn in range(8):
            receipt = feed.ingest("points", "rover", encode_cloud(strip(turn), T0 + turn * 10**9, "map"))
            outcomes.append(feed.decided(receipt.input).outcome)
        assert outcomes[:2] == ["integrated"] * 2
        assert outcomes[-1] == "too_many_tiles"
        send(feed, strip(0), 100)
        status = feed.client.status()
        assert status.health == "degraded"
        assert status.clouds.rejected["too_many_tiles"] == outcomes.count("too_many_tiles")  # type: ignore[index]
        assert status.tiles.spilled <= 13


def test_a_damaged_tile_of_the_store_ends_the_service_by_name(tmp_path: Path) -> None:
    """Found when it is needed; nothing is served on with a part missing."""
    settings = {"store": {"path": str(tmp_path / "map.db")}}
    with running(tmp_path, **settings) as (service, feed):
        send(feed, strip(0), 0)
    with closing(sqlite3.connect(tmp_path / "map.db")) as db, db:
        db.execute("UPDATE tiles SET state = substr(state, 1, 100) WHERE tx = 5")
    with Service(tmp_path, **settings) as service, connected(service) as feed:
        feed.client.region((0.0, 0.0, 6.0, 6.0))
        with pytest.raises(Exception, match=r"tile \(5, 0\) is damaged"):
            feed.client.region((33.0, 0.0, 35.0, 6.0))
        assert service.finished(READY_S) == 1
    assert any("map.db: tile (5, 0) is damaged" in line for line in service.err)
    with running(tmp_path, **settings) as (_, feed):  # rebuilt from the log
        assert feed.client.status().tiles.resident == TILES
