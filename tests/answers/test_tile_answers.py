"""Tiles as a stranger gets them: which ones a selector means, and all that each one says."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
import zstandard
from asking_raw import RawTile, get
from served import INSTANCE, T0, Served

from roughmap_schemas.layers import layers_of

Key = tuple[int, int, int]
LEVELS = 8


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with Served() as served:
        yield served


def known(served: Served) -> dict[Key, int]:
    """Every tile with a known cell, of every level, and its sequence."""
    found = {}
    for z in range(LEVELS):
        with served.map.freeze(z) as frozen:
            for (x, y), sequence in zip(frozen.tiles.tolist(), frozen.sequences.tolist(), strict=True):
                found[z, x, y] = sequence
    return found


def tiles(served: Served, selector: str) -> dict[Key, RawTile]:
    found = get(served.asker, selector).tiles()
    for tile in found.values():
        assert tile.info["answer_tiles"] == len(found)
        assert tile.name == "maps/site/tiles/{}/{}/{}".format(*tile.key)
    return found


SELECTORS = {
    "maps/site/tiles/0/0/0": lambda z, x, y: (z, x, y) == (0, 0, 0),
    "maps/site/tiles/0/-1/-2": lambda z, x, y: (z, x, y) == (0, -1, -2),
    "maps/site/tiles/0/*/*": lambda z, x, y: z == 0,
    "maps/site/tiles/3/*/*": lambda z, x, y: z == 3,
    "maps/site/tiles/*/0/*": lambda z, x, y: x == 0,
    "maps/site/tiles/0/*/-1": lambda z, x, y: z == 0 and y == -1,
    "maps/site/tiles/*/*/*": lambda z, x, y: True,
    "maps/*/tiles/1/*/0": lambda z, x, y: z == 1 and y == 0,
    "*/site/tiles/7/*/*": lambda z, x, y: z == 7,
    "maps/site/tiles/**": lambda z, x, y: True,
    "maps/site/tiles/0/**": lambda z, x, y: z == 0,
    "maps/site/tiles/**/0": lambda z, x, y: y == 0,
    "**/tiles/2/**": lambda z, x, y: z == 2,
    "maps/site/tiles/0/-$*/*": lambda z, x, y: z == 0 and x < 0,
    "maps/site/tiles/*/$*1/0": lambda z, x, y: str(x).endswith("1") and y == 0,
}


@pytest.mark.parametrize("selector", SELECTORS)
def test_which_tiles_a_selector_means(served: Served, selector: str) -> None:
    expected = {key for key in known(served) if SELECTORS[selector](*key)}
    assert expected, "the selector means something here"
    assert set(tiles(served, selector)) == expected


@pytest.mark.parametrize("selector", ["0/5000/0", "0/0/-2147483648", "7/2147483647/0", "3/*/77", "0/9$*9/*"])
def test_absence_is_no_error(served: Served, selector: str) -> None:
    assert tiles(served, f"maps/site/tiles/{selector}") == {}


def test_what_a_tile_says_of_itself(served: Served) -> None:
    everything, sequences = tiles(served, "maps/site/tiles/*/*/*"), known(served)
    assert set(everything) == set(sequences)
    assert len(set(sequences.values())) > 3, "tiles of several scans"
    for (z, x, y), tile in everything.items():
        with served.map.freeze(z) as frozen:
            oldest, newest = frozen.stamps(x, y)
            expected = {
                "contract": "1.0", "map": "site", "instance": INSTANCE, "epoch": 5, "z": z, "x": x, "y": y,
                "sequence": sequences[z, x, y], "map_sequence": 5, "answer_tiles": len(everything),
                "oldest_ns": oldest, "newest_ns": newest, "known_cells": frozen.known_cells(x, y),
                "digest": frozen.digest(x, y), "configuration_digest": served.digest, "compression": None,
                "surface": "all",
            }  # fmt: skip
        assert tile.info == expected
        assert T0 <= oldest <= newest == tile.stamp_ns
        grid, side = tile.grid, 0.1 * 2**z
        assert (grid.cell_size.x, grid.cell_size.y) == (side, side)
        assert (grid.pose.position.x, grid.pose.position.y, grid.pose.position.z) == (x * 64 * side, y * 64 * side, 0)
        q = grid.pose.orientation
        assert (q.x, q.y, q.z, q.w) == (0, 0, 0, 1)
        assert (grid.frame_id, grid.column_count) == ("map", 64)
        assert {layer.shape for layer in tile.layers().values()} == {(64, 64)}
        assert [field.name for field in grid.fields] == ["mean_height"]


@pytest.mark.parametrize(("dtype", "level"), list(itertools.product(["f4", "f8"], [0, 1, 4])))
def test_values_are_those_of_the_map(served: Served, dtype: str, level: int) -> None:
    names = list(layers_of("all"))[::-1]  # any order that is asked for
    found = tiles(served, f"maps/site/tiles/{level}/*/*?layers={','.join(names)};dtype={dtype}")
    assert found
    with served.map.freeze(level) as frozen:
        for (_, x, y), tile in found.items():
            layers, expected = tile.layers(), frozen.tile_layers(x, y, names)
            assert list(layers) == names
            for name in names:
                assert layers[name].dtype == np.dtype(f"<{dtype}")
                np.testing.assert_array_equal(layers[name], expected[name].astype(dtype), err_msg=name)


def test_unknown_is_nan_but_count_and_weight_are_0(served: Served) -> None:
    tile = tiles(served, "maps/site/tiles/0/-7/2?layers=mean_height,count,weight,traversability")[0, -7, 2]
    layers = tile.layers()
    unknown = layers["count"] == 0
    assert np.count_nonzero(~unknown) == tile.info["known_cells"] > 0
    assert unknown.any()
    assert (layers["weight"][unknown] == 0).all()
    np.testing.assert_array_equal(np.isnan(layers["mean_height"]), unknown)
    assert np.isnan(layers["traversability"][unknown]).all()


def test_compression_changes_the_bytes_alone(served: Served) -> None:
    selector = "maps/site/tiles/0/0/0?layers=mean_height,range"
    plain, packed = tiles(served, selector)[0, 0, 0], tiles(served, f"{selector};compression=zstd")[0, 0, 0]
    assert packed.info == {**plain.info, "compression": "zstd"}
    assert len(packed.grid.data) < len(plain.grid.data)
    assert zstandard.decompress(packed.grid.data) == plain.grid.data
    packed.grid.data = plain.grid.data
    assert packed.grid == plain.grid


def test_rows_go_along_y_from_the_lowest_corner(served: Served) -> None:
    """By the mosaic of the library, cut where the tile lies."""
    tile = tiles(served, "maps/site/tiles/0/1/-1?dtype=f8")[0, 1, -1]
    region = served.map.region((6.4, -6.4, 12.8, 0.0), ["mean_height"])
    np.testing.assert_array_equal(tile.layers()["mean_height"], region["mean_height"])


def test_a_query_is_recorded_in_the_log(served: Served) -> None:
    selector = "maps/site/tiles/0/0/*?layers=range"
    served.records.clear()
    count = len(tiles(served, selector))
    with served.recorded:
        # A record comes after its answer: that of an earlier query may only come now.
        assert served.recorded.wait_for(lambda: selector in [record.selector for record in served.records], 30.0)
    (record,) = [record for record in served.records if record.selector == selector]
    assert (record.tiles, record.sequence, record.outcome) == (count, 5, "ok")
    assert record.duration_ns > 0
