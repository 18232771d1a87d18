"""What the parameters of a tile query choose: box, changes since a version, tolerance, limits."""

from collections.abc import Iterator

import numpy as np
import pytest
from asking_raw import RawTile, get
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from properties import examples
from served import T0, Served, some_points

Key = tuple[int, int, int]


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A map that no test changes."""
    with Served() as served:
        yield served


@pytest.fixture
def changing() -> Iterator[Served]:
    """A map of its own for each test."""
    with Served() as served:
        yield served


def tiles(served: Served, selector: str = "0/*/*", **parameters: object) -> dict[Key, RawTile]:
    text = ";".join(f"{name}={value}" for name, value in parameters.items())
    found = get(served.asker, f"maps/site/tiles/{selector}?{text}").tiles()
    assert all(tile.info["answer_tiles"] == len(found) for tile in found.values())
    return found


def box_text(box: tuple[float, ...]) -> str:
    return ",".join(repr(value) for value in box)


edges = st.one_of(
    st.floats(-60.0, 40.0), st.integers(-8, 5).map(lambda n: n * 64 * 0.1), st.sampled_from([-1e300, -3e8, 3e8, 1e300])
)
"""Also the borders of tiles, and what lies far beyond any cell."""


@examples(60, HealthCheck.function_scoped_fixture)
@given(xs=st.tuples(edges, edges), ys=st.tuples(edges, edges), level=st.sampled_from([0, 0, 1, 3, 7]))
def test_a_box_means_the_tiles_that_it_meets(
    served: Served, xs: tuple[float, float], ys: tuple[float, float], level: int
) -> None:
    """Half-open box and half-open tiles, both given by products as the cells' edges are."""
    (xmin, xmax), (ymin, ymax) = sorted(xs), sorted(ys)
    if xmin == xmax or ymin == ymax:
        return
    side = 64 * (0.1 * 2**level)
    with served.map.freeze(level) as frozen:
        every = [tuple(tile) for tile in frozen.tiles.tolist()]
    expected = {
        (level, x, y)
        for x, y in every
        if xmin < (x + 1) * side and x * side < xmax and ymin < (y + 1) * side and y * side < ymax
    }
    assert set(tiles(served, f"{level}/*/*", bbox=box_text((xmin, ymin, xmax, ymax)))) == expected


def test_a_box_is_in_metres_at_every_level_and_the_tiles_are_whole(served: Served) -> None:
    found = tiles(served, "*/*/*", bbox="1,1,1.05,1.05")
    assert set(found) == {(z, 0, 0) for z in range(8)}
    for tile in found.values():
        assert tile.grid.column_count == 64
    whole = tiles(served, "0/0/0")[0, 0, 0]
    assert found[0, 0, 0].grid == whole.grid


def test_a_box_with_a_key(served: Served) -> None:
    assert set(tiles(served, "0/0/*", bbox="-100,0,100,6.4")) == {(0, 0, 0)}
    assert tiles(served, "0/0/*", bbox="6.4,0,100,6.4") == {}


def test_tolerance(served: Served) -> None:
    for tolerance in (0.002, 0.3):
        found = tiles(served, "1/*/*", layers="confidence_level", tolerance=tolerance, dtype="f8")
        with served.map.freeze(1) as frozen:
            for (_, x, y), tile in found.items():
                expected = frozen.tile_layers(x, y, ["confidence_level"], tolerance)
                np.testing.assert_array_equal(tile.layers()["confidence_level"], expected["confidence_level"])


def test_limits_are_those_asked_for_and_else_the_maps(served: Served) -> None:
    given = {"slope": 0.9, "confidence": 0.5}
    asked = tiles(served, "0/0/0", layers="traversability", dtype="f8", limits="slope:0.9,confidence:0.5")[0, 0, 0]
    default = tiles(served, "0/0/0", layers="traversability", dtype="f8")[0, 0, 0]
    with served.map.freeze(0) as frozen:
        for tile, limits in ((asked, given), (default, dict(served.config.map.limits))):
            expected = frozen.tile_layers(0, 0, ["traversability"], served.config.map.height_tolerance, limits)
            np.testing.assert_array_equal(tile.layers()["traversability"], expected["traversability"])
    assert not np.array_equal(*(t.layers()["traversability"] for t in (asked, default)), equal_nan=True)


def test_the_maps_own_tolerance_and_limits_hold_where_none_are_asked_for() -> None:
    limits = {"slope": 0.05, "step": 0.01}
    names = ("confidence_level", "traversability")
    with Served(settings={"map": {"name": "site", "height_tolerance": 0.011, "limits": limits}}) as served:
        tile = tiles(served, "0/0/0", layers=",".join(names), dtype="f8")[0, 0, 0]
        with served.map.freeze(0) as frozen:
            expected = frozen.tile_layers(0, 0, names, 0.011, served.config.map.limits)
        for name in names:
            np.testing.assert_array_equal(tile.layers()[name], expected[name])


@pytest.mark.parametrize("parameters", ["tolerance=1e308", "tolerance=1e-308", "limits=slope:1e-308,confidence:1e308"])
def test_extreme_numbers_get_an_answer(served: Served, parameters: str) -> None:
    found = get(served.asker, f"maps/site/tiles/*/*/*?layers=confidence_level,traversability;{parameters}").tiles()
    for tile in found.values():
        for name, layer in tile.layers().items():
            known = layer[~np.isnan(layer)]
            assert ((known >= 0) & (known <= 1)).all(), name


def test_since_in_the_same_epoch_means_what_changed_after(served: Served) -> None:
    every = tiles(served, "*/*/*")
    sequences = {key: tile.info["sequence"] for key, tile in every.items()}
    for since in range(6):
        found = tiles(served, "*/*/*", since=since, epoch=5)
        assert set(found) == {key for key, sequence in sequences.items() if sequence > since}
        assert {key: tile.info["sequence"] for key, tile in found.items()} == {key: sequences[key] for key in found}


@pytest.mark.parametrize("epoch", [0, 4, 6, 999])
def test_since_in_another_epoch_means_all(served: Served, epoch: int) -> None:
    """Even if that sequence lies ahead: those of another epoch can't be compared."""
    assert set(tiles(served, "*/*/*", since=10**18, epoch=epoch)) == set(tiles(served, "*/*/*"))


def test_a_scan_changes_its_tiles_and_those_beside(changing: Served) -> None:
    """A point in a tile's last column changes the slope of the tile beyond."""
    held = tiles(changing)
    sequence = changing.add(np.array([[6.38, 3.0, 5.0]]))
    found = tiles(changing, since=5, epoch=5)
    assert set(found) == {(0, 0, 0), (0, 1, 0)}
    assert all(tile.info["sequence"] == tile.info["map_sequence"] == sequence for tile in found.values())
    assert set(found) < set(held)


def test_after_a_reset_emptied_tiles_answer_since(changing: Served) -> None:
    held = tiles(changing, "*/*/*")
    changing.reset()
    changing.add(some_points(300, 50, (12.0, 12.0)))
    now = tiles(changing, "*/*/*")
    assert set(now) < set(held)
    found = tiles(changing, "*/*/*", since=5, epoch=5, layers="mean_height,count")
    assert set(found) == set(held)
    for key in set(held) - set(now):
        tile = found[key]
        assert (tile.info["known_cells"], tile.info["sequence"], tile.info["map_sequence"]) == (0, 6, 7)
        assert (tile.info["epoch"], tile.info["oldest_ns"], tile.info["newest_ns"]) == (6, 0, 0)
        layers = tile.layers()
        assert np.isnan(layers["mean_height"]).all()
        assert (layers["count"] == 0).all()
    for key, tile in now.items():
        assert found[key].info["known_cells"] == tile.info["known_cells"] > 0
    assert set(tiles(changing, "*/*/*", since=6, epoch=6)) == set(now), "who knows of the reset is told no more of it"


def test_emptied_tiles_are_those_asked_for(changing: Served) -> None:
    changing.reset()
    assert tiles(changing, "*/*/*") == {}
    assert set(tiles(changing, "0/0/0", since=1, epoch=5)) == {(0, 0, 0)}
    assert set(tiles(changing, "1/*/*", since=1, epoch=5, bbox="1,1,2,2")) == {(1, 0, 0)}
    assert set(tiles(changing, "0/-$*/0", since=1, epoch=5)) == {(0, x, 0) for x in (-8, -7, -6, -5, -2, -1)}


def test_emptied_tiles_are_reported_over_several_resets(changing: Served) -> None:
    first = set(tiles(changing))
    changing.reset()
    changing.add(some_points(300, 51, (500.0, 0.0)), T0)
    second = set(tiles(changing))
    changing.reset()
    found = tiles(changing, since=3, epoch=5)
    assert set(found) == first | second
    assert {tile.info["known_cells"] for tile in found.values()} == {0}


def test_forgotten_tiles_answer_since_in_the_same_epoch(changing: Served) -> None:
    """Who held them learns that they are gone, at each level; who asked later isn't told."""
    held = tiles(changing, "*/*/*")
    before = changing.map.sequence
    sequence, epoch, number = changing.forget((-2, -1, -1, 0), None, "")
    assert (sequence, epoch, number) == (before + 1, changing.epoch, 4)
    now = tiles(changing, "*/*/*")
    gone = set(held) - set(now)
    assert {key for key in gone if key[0] == 0} == {(0, x, y) for x in (-2, -1) for y in (-1, 0)}
    found = tiles(changing, "*/*/*", since=before, epoch=epoch, layers="mean_height,count")
    assert {key for key, tile in found.items() if tile.info["known_cells"] == 0} == gone
    for key in gone:
        assert (found[key].info["sequence"], found[key].info["epoch"]) == (sequence, epoch)
        assert np.isnan(found[key].layers()["mean_height"]).all()
    above = {(z, x >> z, y >> z) for z in range(1, 8) for x in (-2, -1) for y in (-1, 0)}
    assert above - gone <= set(found), "coarser tiles that lost a part have changed"
    assert tiles(changing, "*/*/*", since=sequence, epoch=epoch) == {}
    changing.add(some_points(300, 52), T0)
    assert (0, -1, 0) in tiles(changing, since=sequence, epoch=epoch)
    assert not {key for key, tile in tiles(changing, since=before, epoch=epoch).items() if not tile.info["known_cells"]}
