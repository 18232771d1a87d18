"""Answers while a writer goes on: each is all of one state of the map, whatever was asked and whenever."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from asking_raw import RawTile, get
from net import WAIT_S
from served import Served

SCAN = 40
FIRST = 5 * 1500
BOX = "-60,-60,60,60"


@contextmanager
def writing(served: Served) -> Iterator[None]:
    """Scan after scan, each of `SCAN` points over all of the ground that is known already."""
    stop, failed = threading.Event(), []

    def write() -> None:
        rng = np.random.default_rng(2)
        while not stop.is_set():
            try:
                x, y = rng.uniform(-20.0, 20.0, (2, SCAN))
                served.add(np.column_stack([x, y, rng.normal(0.0, 0.1, SCAN)]))
            except BaseException as error:
                failed.append(error)
                raise

    thread = threading.Thread(target=write)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(WAIT_S)
    assert not thread.is_alive()
    assert not failed


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """With `point` each point counts in one cell: the sum over the map tells how many scans are in it."""
    settings = {"map": {"name": "site", "error_model": "point", "levels": 3}}
    with Served(settings=settings) as served, writing(served):
        yield served


def points(sequence: int) -> int:
    """How many points the map holds at a sequence."""
    return FIRST + SCAN * (sequence - 5)


def count(tiles: list[RawTile]) -> int:
    return int(sum(tile.layers()["count"].sum() for tile in tiles))


def test_tiles_of_all_levels_are_of_one_sequence(served: Served) -> None:
    seen = []
    for _ in range(25):
        tiles = list(get(served.asker, "maps/site/tiles/*/*/*?layers=count;dtype=f8").tiles().values())
        (state,) = {(tile.info["epoch"], tile.info["map_sequence"], tile.info["answer_tiles"]) for tile in tiles}
        assert state[2] == len(tiles)
        sequence = state[1]
        for level in range(3):
            of_level = [tile for tile in tiles if tile.info["z"] == level]
            assert count(of_level) == points(sequence), f"level {level} of sequence {sequence}"
            # Every scan reaches over the whole ground, and so some tile is as new as the map.
            assert max(tile.info["sequence"] for tile in of_level) == sequence
        seen.append(sequence)
    assert seen == sorted(seen)
    assert seen[-1] > seen[0], "the writer wrote meanwhile"


@pytest.mark.parametrize("level", [0, 2])
def test_regions_are_of_one_sequence(served: Served, level: int) -> None:
    for _ in range(6):
        (sample,) = get(served.asker, f"maps/site/region?layers=count;dtype=f8;bbox={BOX};level={level}").ok
        region = RawTile(sample)
        assert count([region]) == points(region.info["map_sequence"])
        assert region.info["known_cells"] == np.count_nonzero(region.layers()["count"])


def test_cells_are_of_the_sequence_that_they_name(served: Served) -> None:
    """One point a scan falls into each of these cells: the counts of all rise together."""
    places = [[x + 0.05, 300.05] for x in range(20)]
    first = served.add(np.array([[x, y, 1.0] for x, y in places]))
    for number in range(6):
        answer = get(served.asker, "maps/site/cells", str(places).encode()).json()
        counts = {cell["state"]["count"] for cell in answer["cells"]}
        assert counts == {number + 1}
        assert answer["sequence"] >= first
        first = served.add(np.array([[x, y, 1.0] for x, y in places]))


def test_following_since_misses_nothing(served: Served) -> None:
    """Tiles taken over by `since`, answer by answer, are those of one whole answer."""
    held: dict[tuple[int, int, int], RawTile] = {}
    since = 0
    for _ in range(15):
        tiles = get(served.asker, f"maps/site/tiles/0/*/*?layers=count;dtype=f8;since={since};epoch=5").tiles()
        held |= tiles
        if tiles:
            since = next(iter(tiles.values())).info["map_sequence"]
            elsewhere = [tile for tile in held.values() if tile.info["y"] < 30]  # not the cells of the test above
            extra = [tile for tile in held.values() if tile.info["y"] >= 30]
            assert count(elsewhere) + count(extra) == count(list(held.values()))
    whole = {}
    while not whole or next(iter(whole.values())).info["map_sequence"] != since:
        tiles = get(served.asker, f"maps/site/tiles/0/*/*?layers=count;dtype=f8;since={since};epoch=5").tiles()
        held |= tiles
        if tiles:
            since = next(iter(tiles.values())).info["map_sequence"]
        whole = get(served.asker, "maps/site/tiles/0/*/*?layers=count;dtype=f8").tiles()
