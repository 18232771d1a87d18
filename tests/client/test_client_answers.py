"""What the client hands on: regions, tiles, changes, cells, status; against the map itself."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from served import INSTANCE, T0, Served, some_points

from roughmap_client import Changes, QueryRefused, RoughMapClient, Tile, Version

BOX = (-3.05, -7.0, 9.27, 6.61)


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A map that no test changes."""
    with Served(settings={"query": {"max_reply_tiles": 200}}) as served:
        yield served


@pytest.fixture(scope="module")
def client(served: Served) -> Iterator[RoughMapClient]:
    with RoughMapClient("site", session=served.asker, timeout=30.0) as client:
        yield client


@pytest.fixture
def changing() -> Iterator[tuple[Served, RoughMapClient]]:
    """A map of its own for each test."""
    with Served() as served, RoughMapClient("site", session=served.asker, timeout=30.0) as client:
        yield served, client


@pytest.mark.parametrize("level", [0, 2])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_a_region_is_the_maps(served: Served, client: RoughMapClient, level: int, dtype: Any) -> None:
    names = ["range", "mean_height", "count", "slope"]
    region, expected = client.region(BOX, names, level=level, dtype=dtype), served.map.region(BOX, names, level)
    assert list(region) == names
    assert len(region) == 4
    for name in names:
        assert region[name].dtype == np.dtype(dtype)
        np.testing.assert_array_equal(region[name], expected[name].astype(dtype), err_msg=name)
    assert np.isnan(region["mean_height"]).any()
    assert (region.origin, region.cell_size, region.level) == (expected.origin, expected.cell_size, level)
    assert region.shape == region["range"].shape == expected.shape
    (x, y), (ny, nx), side = expected.origin, expected.shape, expected.cell_size
    assert region.extent == (x, y, x + nx * side, y + ny * side)
    assert region.version == (5, 5, INSTANCE)
    assert (region.epoch, region.sequence) == (5, 5)
    assert region.known_cells == np.count_nonzero(expected["count"])


def test_tolerance_and_limits_reach_the_service(served: Served, client: RoughMapClient) -> None:
    names, limits = ["confidence_level", "traversability"], {"slope": 0.7, "range": 0.4}
    region = client.region(BOX, names, tolerance=0.013, limits=limits, dtype="f8")
    expected = served.map.region(BOX, names, 0, 0.013, limits)
    cells = client.cells([(0.0, 0.0), (1.0, 1.0)], names, tolerance=0.013, limits=limits)
    for name in names:
        np.testing.assert_array_equal(region[name], expected[name])
        for (x, y), value in zip([(0.0, 0.0), (1.0, 1.0)], cells[name], strict=True):
            row, column = round((y - expected.origin[1]) / 0.1), round((x - expected.origin[0]) / 0.1)
            np.testing.assert_array_equal(value, expected[name][row, column])


@pytest.mark.parametrize("level", [0, 1, 7])
def test_tiles_are_the_maps(served: Served, client: RoughMapClient, level: int) -> None:
    tiles = client.tiles(layers=["mean_height", "age"], level=level)
    with served.map.freeze(level) as frozen:
        assert [tile.key for tile in tiles] == [(level, x, y) for x, y in frozen.tiles.tolist()]
        for tile in tiles:
            assert tile.info.digest == frozen.digest(*tile.key[1:])
            for name, plane in frozen.tile_layers(*tile.key[1:], ["mean_height", "age"]).items():
                np.testing.assert_array_equal(tile[name], plane.astype("f4"))
            assert tile.origin == (tile.key[1] * 64 * tile.cell_size, tile.key[2] * 64 * tile.cell_size)
    assert {tile.version for tile in tiles} == {Version(5, 5, INSTANCE)}


def test_no_tile_is_an_empty_list_and_no_error(client: RoughMapClient) -> None:
    assert client.tiles((500.0, 500.0, 501.0, 501.0)) == []
    assert [tile.key for tile in client.tiles((0.0, 0.0, 6.4, 6.4))] == [(0, 0, 0)]


def test_cells_come_in_the_order_of_the_places(served: Served, client: RoughMapClient) -> None:
    rng = np.random.default_rng(3)
    places = rng.uniform(-12.0, 12.0, (400, 2))
    cells = client.cells(places, ["mean_height", "count"])
    assert (cells.i == np.floor(places[:, 0] / 0.1)).all()
    assert (cells.j == np.floor(places[:, 1] / 0.1)).all()
    with served.map.freeze(0) as frozen:
        for number, (i, j) in enumerate(zip(cells.i.tolist(), cells.j.tolist(), strict=True)):
            record = frozen.records(i >> 6, j >> 6)[j & 63, i & 63]
            state = cells.states[number]
            assert cells.known[number] == bool(record["count"]) == (state is not None)
            assert cells["count"][number] == record["count"]
            if state is not None:
                assert {name: getattr(state, name) for name in record.dtype.names} == dict(
                    zip(record.dtype.names, record.item(), strict=True)
                )
                assert cells["mean_height"][number] == record["mean"]
    np.testing.assert_array_equal(np.isnan(cells["mean_height"]), ~cells.known)
    assert 0 < np.count_nonzero(cells.known) < 400
    assert (cells.version, cells.instance) == (Version(5, 5, INSTANCE), INSTANCE)


def test_one_place_and_none(client: RoughMapClient) -> None:
    assert client.cells((0.25, -0.35)).i.tolist() == [2]
    nothing = client.cells(np.empty((0, 2)))
    assert (nothing.i.shape, nothing["mean_height"].shape, nothing.states) == ((0,), (0,), [])


def test_threads_that_share_a_client_each_get_their_own_answer(client: RoughMapClient) -> None:
    boxes = [(0.1 * x, -1.0, 0.1 * x + 1.0, 1.0) for x in range(-40, 40, 5)]
    alone = [client.region(box) for box in boxes]
    assert len({region["mean_height"].tobytes() for region in alone}) == len(boxes)
    with ThreadPoolExecutor(8) as pool:
        for region, expected in zip(pool.map(client.region, boxes * 4), alone * 4, strict=True):
            assert region.origin == expected.origin
            np.testing.assert_array_equal(region["mean_height"], expected["mean_height"])


def test_status(served: Served, client: RoughMapClient) -> None:
    status = client.status()
    assert (status.map, status.instance, status.epoch, status.sequence) == ("site", INSTANCE, 5, 5)
    assert status.extent == served.map.extent()


@pytest.mark.parametrize(
    ("ask", "code"),
    [
        (lambda c: c.region((0, 0, 0, 1)), "bad_bbox"),
        (lambda c: c.region((0, 0, float("nan"), 1)), "bad_bbox"),
        (lambda c: c.region((0, 0, 1e6, 1e6)), "too_large"),
        (lambda c: c.region((0, 0, 1, 1), level=8), "bad_level"),
        (lambda c: c.region((0, 0, 1, 1), ["height"]), "unknown_layer"),
        (lambda c: c.region((0, 0, 1, 1), tolerance=0.0), "bad_parameter"),
        (lambda c: c.tiles(level=-1), "bad_level"),
        (lambda c: c.changes(layers=["height"]), "unknown_layer"),
        (lambda c: c.cells(np.zeros((10_001, 2))), "too_large"),
        (lambda c: c.cells([(float("nan"), 0.0)]), "bad_parameter"),
        (lambda c: c.cells([(1e300, 0.0)]), "bad_parameter"),
    ],
)
def test_a_refusal_has_its_code(client: RoughMapClient, ask: Any, code: str) -> None:
    with pytest.raises(QueryRefused) as caught:
        ask(client)
    assert caught.value.code == code
    assert caught.value.message


def keys(changes: Changes) -> set[tuple[int, int, int]]:
    return {tile.key for tile in changes.tiles}


def test_changes_since_a_version(changing: tuple[Served, RoughMapClient]) -> None:
    served, client = changing
    first = client.changes()
    assert first.complete
    assert (first.version, len(first.tiles)) == ((5, 5, INSTANCE), served.map.tile_count)
    nothing = client.changes(first.version)
    assert (nothing.tiles, nothing.complete, nothing.version) == ([], False, first.version)
    served.add(np.array([[-60.0, 3.2, 1.0]]))
    second = client.changes(nothing.version)
    assert (keys(second), second.complete, second.version) == ({(0, -10, 0)}, False, (5, 6, INSTANCE))
    assert keys(client.changes(first.version, bbox=(0.0, 0.0, 6.0, 6.0))) == set()
    assert keys(client.changes(first.version, level=2)) == {(2, -3, 0)}


def test_after_a_reset_changes_are_complete_and_list_emptied_tiles(changing: tuple[Served, RoughMapClient]) -> None:
    served, client = changing
    held = client.changes()
    served.reset()
    served.add(np.array([[1.0, 1.0, 1.0]]))
    after = client.changes(held.version)
    assert after.complete
    assert after.version == (6, 7, INSTANCE)
    assert keys(after) == keys(held)
    assert {tile.key for tile in after.tiles if tile.known_cells} == {(0, 0, 0)}
    assert client.changes(after.version).tiles == []


@pytest.mark.parametrize("level", [0, 1])
def test_following_the_changes_gives_the_whole_map(changing: tuple[Served, RoughMapClient], level: int) -> None:
    """Whatever is added and forgotten between, and though it was reset: what a planner holds is what the map is."""
    served, client = changing
    rng = np.random.default_rng(8)
    held: dict[tuple[int, int, int], Tile] = {}
    version, fewer = None, 0
    for step in range(12):
        if step == 7:
            served.reset()
        if step in {4, 9}:
            served.forget((-1, -1, 0, 0), None, "")
        for _ in range(rng.integers(0, 3)):
            served.add(some_points(50, int(rng.integers(1000)), tuple(rng.uniform(-20, 20, 2))), T0 + step)
        changes = client.changes(version, level=level)
        assert changes.complete == (step in {0, 7})
        if changes.complete:
            held.clear()
        held |= {tile.key: tile for tile in changes.tiles}
        version = changes.version
        with served.map.freeze(level) as frozen:
            now = {(level, x, y): frozen.digest(x, y) for x, y in frozen.tiles.tolist()}
        assert {key: tile.info.digest for key, tile in held.items() if tile.known_cells} == now
        fewer += len(changes.tiles) < len(now)
    assert fewer > 3, "mostly a part of the tiles was enough"


def test_forgetting_a_box(changing: tuple[Served, RoughMapClient]) -> None:
    _, client = changing
    held = client.changes()
    answer = client.forget((-12.8, -6.4, -0.1, 6.4))
    assert (answer.tiles, answer.sequence, answer.epoch) == (4, held.version.sequence + 1, held.version.epoch)
    changes = client.changes(held.version)
    assert not changes.complete
    gone = {tile.key for tile in changes.tiles if not tile.known_cells}
    assert gone == {(0, x, y) for x in (-2, -1) for y in (-1, 0)}
    left = {tile.key for tile in held.tiles} - gone
    assert {tile.key for tile in client.tiles()} == left
    with pytest.raises(QueryRefused, match="a reset forgets all"):
        client.forget()


def test_a_new_run_is_not_taken_for_the_one_before() -> None:
    """Epoch and sequence may come again, in another process: then what was held says nothing of this map."""
    with Served() as before, RoughMapClient("site", session=before.asker, timeout=30.0) as client:
        held = client.changes()
        before.answers.close()
        with Served(sessions=(before.server, before.asker), instance="9" * 32):
            after = client.changes(held.version)
    assert after.complete
    assert (len(after.tiles), after.version) == (len(held.tiles), (5, 5, "9" * 32))
