"""Answers while a writer goes on: each is all of one state of the map, whatever was asked and whenever."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from asking_raw import RawTile, get
from net import WAIT_S, Gathered
from served import T0, Served

from roughmap import RoughMap
from roughmap_service.run.view import View

SCAN = 40
FIRST = 5 * 1500
BOX = "-60,-60,60,60"


POINT = {"map": {"name": "site", "error_model": "point", "levels": 3}}
"""With `point` each point counts in one cell: the sum over the map tells how many scans are in it."""


def scattered(rng: np.random.Generator) -> np.ndarray:
    """`SCAN` points over all of the ground that is known already."""
    x, y = rng.uniform(-20.0, 20.0, (2, SCAN))
    return np.column_stack([x, y, rng.normal(0.0, 0.1, SCAN)])


@contextmanager
def writing(served: Served, scan: Callable[[np.random.Generator], np.ndarray]) -> Iterator[Gathered[int]]:
    """Scan after scan, as fast as they are taken; the sequences that they make."""
    stop = threading.Event()
    written: Gathered[int] = Gathered()

    def write() -> None:
        rng = np.random.default_rng(2)
        while not stop.is_set():
            written(served.add(scan(rng)))

    thread = threading.Thread(target=write)
    thread.start()
    try:
        yield written
    finally:
        stop.set()
        thread.join(WAIT_S)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with Served(settings=POINT) as served:
        yield served


@pytest.fixture(scope="module")
def written(served: Served) -> Iterator[Gathered[int]]:
    with writing(served, scattered) as written:
        yield written


def points(sequence: int) -> int:
    """How many points the map holds at a sequence."""
    return FIRST + SCAN * (sequence - 5)


def count(tiles: list[RawTile]) -> int:
    return int(sum(tile.layers()["count"].sum() for tile in tiles))


def test_tiles_of_all_levels_are_of_one_sequence(served: Served, written: Gathered[int]) -> None:
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
        written.wait(lambda sequences, after=sequence: sequences[-1] > after, "the next scan")
    assert seen == sorted(set(seen)), "each answer is newer than the one before"


@pytest.mark.usefixtures("written")
@pytest.mark.parametrize("level", [0, 2])
def test_regions_are_of_one_sequence(served: Served, level: int) -> None:
    for _ in range(6):
        (sample,) = get(served.asker, f"maps/site/region?layers=count;dtype=f8;bbox={BOX};level={level}").ok
        region = RawTile(sample)
        assert count([region]) == points(region.info["map_sequence"])
        assert region.info["known_cells"] == np.count_nonzero(region.layers()["count"])


def test_cells_are_of_the_sequence_that_they_name() -> None:
    """One point a scan falls into each of these cells: the counts of all are the number of scans."""
    places = [[25.0 * x + 0.05, 300.05] for x in range(20)]  # in as many tiles
    scan = np.array([[x, y, 1.0] for x, y in places])
    with Served(settings=POINT) as served:
        served.add(scan)
        with writing(served, lambda _: scan):
            for _ in range(25):
                answer = get(served.asker, "maps/site/cells", str(places).encode()).json()
                assert {cell["state"]["count"] for cell in answer["cells"]} == {answer["sequence"] - 5}


def test_following_since_misses_nothing() -> None:
    """What is taken over answer by answer is in the end the map."""
    held: dict[tuple[int, int, int], RawTile] = {}
    selector, since, answers = "maps/site/tiles/0/*/*?epoch=5;since=", 0, 0
    with Served(settings=POINT) as served:

        def follow() -> int:
            tiles = get(served.asker, f"{selector}{since}").tiles()
            assert all(since < tile.info["sequence"] <= tile.info["map_sequence"] for tile in tiles.values())
            held.update(tiles)
            return next((int(tile.info["map_sequence"]) for tile in tiles.values()), since)

        with writing(served, lambda rng: scattered(rng)[:2]):  # few points, so that most tiles stay as they are
            while answers < 25:
                since, answers = follow(), answers + 1
        since = follow()
        assert since == served.map.sequence > 5
        with served.map.freeze() as frozen:
            assert {key: tile.info["digest"] for key, tile in held.items()} == {
                (0, x, y): frozen.digest(x, y) for x, y in frozen.tiles.tolist()
            }


class Restless(View):
    """A map that changes whenever a reader lets go of it: what is read in two holds is of two states."""

    @contextmanager
    def reading(self) -> Iterator[RoughMap]:
        with super().reading() as rough_map:
            yield rough_map
        with self.change() as rough_map:
            rough_map.add(scattered(np.random.default_rng(rough_map.sequence)), None, T0)


def test_an_answer_is_read_in_one_hold_of_the_map() -> None:
    made = Served(settings=POINT)
    made.view = Restless(made.map, 5)
    with made as served:
        tiles = list(get(served.asker, "maps/site/tiles/*/*/*?layers=count;dtype=f8").tiles().values())
        (sequence,) = {tile.info["map_sequence"] for tile in tiles}
        for level in range(3):
            assert count([tile for tile in tiles if tile.info["z"] == level]) == points(sequence)
        (sample,) = get(served.asker, f"maps/site/region?layers=count;dtype=f8;bbox={BOX}").ok
        region = RawTile(sample)
        assert count([region]) == points(region.info["map_sequence"])
        assert served.map.sequence > region.info["map_sequence"] > sequence
