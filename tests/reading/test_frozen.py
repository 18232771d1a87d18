"""Frozen maps: their content while the map changes."""

import threading

import numpy as np
import pytest
import xxhash
from read_tools import TILE_SHAPE, chance_tile, state_of

from roughmap.map import RoughMap
from roughmap.reading import levels
from roughmap.reading.cell_values import cell_layers
from roughmap.reading.layers import CELL_LAYERS, layers_of
from roughmap.settings import SURFACES
from roughmap.tiles.digest import tile_digest

SIDE = 0.25


@pytest.fixture(params=SURFACES)
def m(request: pytest.FixtureRequest) -> RoughMap:
    return RoughMap(cell_size=SIDE, error_model="point", surface=request.param, threads=1)


def put(m: RoughMap, *points: tuple[float, float, float], stamp_s: int = 0) -> None:
    """Points given in cells along x and y."""
    where = np.array(points, dtype=float)
    where[:, :2] = (where[:, :2] + 0.5) * SIDE
    m.add(where, stamp_ns=stamp_s * 10**9)


def load(m: RoughMap, tiles: dict[tuple[int, int], np.ndarray]) -> None:
    for (x, y), records in tiles.items():
        m.load_tile(x, y, state_of(records), 1_000, 2_000)


def test_an_empty_map(m: RoughMap) -> None:
    for level in (0, 7):
        with m.freeze(level=level) as frozen:
            assert frozen.tiles.shape == (0, 2)
            assert frozen.sequences.shape == (0,)
            assert (frozen.sequence, frozen.newest_updated) == (0, 0)
            assert not frozen.records(0, 0)["count"].any()


def test_a_tile_row_by_row(m: RoughMap) -> None:
    put(m, (3, 5, 1.0), (-1, 0, 2.0), stamp_s=9)
    with m.freeze() as frozen:
        assert frozen.tiles.tolist() == [[-1, 0], [0, 0]]
        assert frozen.records(0, 0).shape == TILE_SHAPE
        assert frozen.records(0, 0)[5, 3]["mean"] == 1.0
        assert frozen.records(-1, 0)[0, 63]["mean"] == 2.0
        assert not frozen.records(0, 0).flags.writeable
        assert not frozen.records(40, 40)["count"].any()
        assert frozen.known_cells(0, 0) == 1
        assert frozen.known_cells(40, 40) == 0
        assert frozen.stamps(0, 0) == (9 * 10**9, 9 * 10**9)
        with pytest.raises(KeyError):
            frozen.stamps(40, 40)
        assert frozen.newest_updated == 9
        assert frozen.cell_size == SIDE


def test_tiles_outside_every_map_are_absent(m: RoughMap) -> None:
    put(m, (0, 0, 1.0))
    for x, y in [(0, 2**32), (-1, 2**32), (2**70, 0), (0, -(2**70)), (2**25, -(2**25) - 1)]:
        with m.freeze(box=(x, y, x, y)) as frozen, m.freeze() as whole:
            assert len(frozen.tiles) == 0
            assert frozen.known_cells(x, y) == whole.known_cells(x, y) == 0


def test_a_loaded_tile_is_seen_at_all_levels(m: RoughMap) -> None:
    """Loading changes cells without a new sequence; merged tiles cached before must not be used for the new state."""
    put(m, (0, 0, 1.0))
    with m.freeze(level=2) as frozen:
        assert frozen.known_cells(0, 0) == 1
    load(m, {(1, 1): chance_tile(1)})
    with m.freeze(level=2) as frozen:
        assert frozen.known_cells(0, 0) > 1


def test_the_digest_is_that_of_the_state(m: RoughMap) -> None:
    tile = chance_tile(3)
    load(m, {(-2, 7): tile})
    with m.freeze() as frozen:
        assert frozen.digest(-2, 7) == tile_digest(state_of(tile)).hex()
        assert frozen.records(-2, 7).tobytes() == tile.tobytes()
    x, y, digests = m.tile_digests()
    assert (x.tolist(), y.tolist()) == ([-2], [7])
    assert digests[0].tobytes().hex() == tile_digest(state_of(tile)).hex()


def test_later_changes_do_not_show(m: RoughMap) -> None:
    put(m, (0, 0, 1.0), (64, 0, 1.5), stamp_s=5)
    before = m.freeze()
    coarse_before = m.freeze(level=2)
    names = layers_of(m.settings.surface)
    seen = {name: before.tile_layers(0, 0, names)[name].copy() for name in names}
    put(m, (0, 0, 1.1), (1, 0, 1.1), (300, 0, 1.1), stamp_s=50)
    with m.freeze() as after, m.freeze(level=2) as coarse_after:
        assert after.records(0, 0)[0, 0]["count"] == 2
        assert after.tiles.tolist() == [[0, 0], [1, 0], [4, 0]]
        assert coarse_after.records(0, 0)[0, 0]["max"] == 1.1
        assert coarse_after.tiles.tolist() == [[0, 0], [1, 0]]
    for name, plane in before.tile_layers(0, 0, names).items():
        np.testing.assert_array_equal(plane, seen[name])
    assert before.tiles.tolist() == [[0, 0], [1, 0]]
    assert (before.sequence, before.newest_updated) == (1, 5)
    assert before.sequences.tolist() == [1, 1]
    assert coarse_before.records(0, 0)[0, 0]["max"] == 1.0
    assert coarse_before.tiles.tolist() == [[0, 0]]
    before.close()
    coarse_before.close()
    before.close()


def test_a_frozen_map_outlives_a_reset(m: RoughMap) -> None:
    put(m, (0, 0, 1.0))
    with m.freeze() as frozen, m.freeze(level=1) as coarse:
        m.reset()
        put(m, (0, 0, 5.0))
        assert frozen.records(0, 0)[0, 0]["mean"] == 1.0
        assert coarse.records(0, 0)[0, 0]["mean"] == 1.0
    with m.freeze(level=1) as coarse:
        assert coarse.records(0, 0)[0, 0]["mean"] == 5.0


def test_a_closed_frozen_map_refuses_reads(m: RoughMap) -> None:
    put(m, (0, 0, 1.0))
    frozen = m.freeze()
    frozen.close()
    with pytest.raises(ValueError, match="closed"):
        frozen.records(0, 0)


def test_a_dropped_frozen_map_warns_and_releases_its_tiles(m: RoughMap) -> None:
    put(m, (0, 0, 1.0), (100, 0, 1.0))
    m.freeze().close()
    used = m.memory_bytes
    dropped = m.freeze()
    put(m, (0, 0, 1.1))
    held = m.memory_bytes
    assert held > used  # the old copy of a tile is still pinned
    leaving = [dropped]
    del dropped
    with pytest.warns(ResourceWarning, match="never closed"):
        leaving.clear()
    m.freeze().close()
    assert m.memory_bytes == used


def test_a_box_includes_its_ring(m: RoughMap) -> None:
    put(m, *((64.0 * x, 64.0 * y, x + 10.0 * y) for x in range(-3, 4) for y in range(-3, 4)))
    with m.freeze(box=(0, -1, 1, -1)) as frozen:
        assert frozen.tiles.tolist() == [[0, -1], [1, -1]]
        assert frozen.records(2, 0)[0, 0]["count"] == 1
        assert frozen.records(-1, -2)[0, 0]["count"] == 1
        assert frozen.records(3, -1)[0, 0]["count"] == 0
        assert frozen.covers((1, -1, 1, -1))
        assert not frozen.covers((0, -1, 2, -1))


def test_a_box_at_the_limit_of_tile_numbers(m: RoughMap) -> None:
    edge = 2**31
    put(m, *[(edge - 1, -edge, 1.0), (edge - 2, -edge, 2.0)] * 2)
    x, y = 2**25 - 1, -(2**25)
    for level in range(8):
        tile = x >> level, y >> level
        with m.freeze(level=level, box=(*tile, *tile)) as frozen:
            assert frozen.tiles.tolist() == [list(tile)]
            step = frozen.tile_layers(*tile, ["step_height"])["step_height"]
            assert (step > 0.0).any() == (level == 0)
    with m.freeze(box=(-(2**31), -(2**31), 2**31, 2**31)) as frozen:
        assert frozen.tiles.tolist() == [[x, y]]


def brute_level(tiles: dict[tuple[int, int], np.ndarray], level: int) -> dict[tuple[int, int], dict[str, float]]:
    """Return sums and extremes of each cell of a level over the level-0 cells below it, by global cell numbers."""
    found: dict[tuple[int, int], dict[str, float]] = {}
    for (x, y), tile in tiles.items():
        for j, i in np.argwhere(tile["count"] > 0).tolist():
            record = tile[j, i]
            key = ((x * 64 + i) >> level, (y * 64 + j) >> level)
            cell = found.setdefault(key, {"count": 0, "weight": 0.0, "moment": 0.0, "min": np.inf, "updated": 0})
            cell["count"] += int(record["count"])
            cell["weight"] += float(record["weight"])
            cell["moment"] += float(record["weight"] * record["mean"])
            cell["min"] = min(cell["min"], float(record["min"]))
            cell["updated"] = max(cell["updated"], int(record["updated"]))
    return found


@pytest.mark.parametrize("level", [1, 2, 3])
def test_levels_of_negative_tiles(m: RoughMap, level: int) -> None:
    tiles = {(x, y): chance_tile(x * 7 + y + 99, 0.2) for x, y in [(-5, -1), (-1, -1), (0, 0), (-1, 0), (3, -4)]}
    load(m, tiles)
    expected = brute_level(tiles, level)
    with m.freeze(level=level) as frozen:
        assert [tuple(t) for t in frozen.tiles.tolist()] == sorted({(x >> level, y >> level) for x, y in tiles})
        known = 0
        for x, y in frozen.tiles.tolist():
            records = frozen.records(x, y)
            assert frozen.known_cells(x, y) == np.count_nonzero(records["count"])
            assert frozen.stamps(x, y) == (1_000, 2_000)
            assert frozen.digest(x, y) == xxhash.xxh3_128_hexdigest(records.tobytes())
            for j, i in np.argwhere(records["count"] > 0).tolist():
                cell, record = expected[x * 64 + i, y * 64 + j], records[j, i]
                known += 1
                assert (record["count"], record["min"], record["updated"]) == (
                    cell["count"],
                    cell["min"],
                    cell["updated"],
                )
                assert record["weight"] == pytest.approx(cell["weight"], rel=1e-13)
                # means below 1: the sum of up to 64 products loses a few 1e-16 each
                assert record["mean"] == pytest.approx(cell["moment"] / cell["weight"], rel=0, abs=1e-13)
        assert known == len(expected)


def test_tile_layers_are_those_of_the_records(m: RoughMap) -> None:
    tile = chance_tile(5)
    load(m, {(0, 0): tile})
    with m.freeze() as frozen:
        names = ("age", "slope", "confidence_level", "traversability", "count")
        got = frozen.tile_layers(0, 0, names, height_tolerance=0.02)
        assert tuple(got) == names
        own = cell_layers(tile, CELL_LAYERS, 0.02, m.newest_updated)
        for name in ("age", "confidence_level", "count"):
            np.testing.assert_array_equal(got[name], own[name])
        assert all(plane.shape == TILE_SHAPE and plane.dtype == np.float64 for plane in got.values())
        names = layers_of(m.settings.surface)
        absent = frozen.tile_layers(9, 9, names)
        assert all((absent[name] == 0).all() for name in ("count", "weight"))
        assert all(np.isnan(absent[name]).all() for name in names if name not in {"count", "weight"})


def test_gradients_cross_the_borders_of_tiles(m: RoughMap) -> None:
    """A tilted plane over four tiles that meet at the origin has one gradient, also at the borders."""
    i, j = np.meshgrid(np.arange(-64, 64), np.arange(-64, 64))
    height = (0.25 * i - 0.5 * j) * SIDE
    put(m, *zip(i.ravel().tolist(), j.ravel().tolist(), height.ravel().tolist(), strict=True))
    for level in (0, 1):
        with m.freeze(level=level) as frozen:
            for x, y in frozen.tiles.tolist():
                got = frozen.tile_layers(x, y, ["gradient_x", "gradient_y", "count"])
                known = got["count"] > 0
                # Binary fractions: every difference and quotient is exact, also the one-sided ones at the rim. A plane
                # of 21 cells is fitted to the ground: its sums are exact, its quotients rounded.
                off = 0.0 if m.settings.surface == "all" else 1e-15
                np.testing.assert_allclose(got["gradient_x"][known], 0.25, rtol=0, atol=off)
                np.testing.assert_allclose(got["gradient_y"][known], -0.5, rtol=0, atol=off)


def test_the_corner_neighbour_lies_three_tiles_away(m: RoughMap) -> None:
    put(m, *[(63, 63, 4.0), (64, 64, 2.5)] * 2)
    with m.freeze(box=(0, 0, 0, 0)) as frozen:
        assert frozen.tile_layers(0, 0, ["step_height"])["step_height"][63, 63] == 1.5


LENIENT = {
    "all": {"slope": 2.0, "step": 0.6, "range": 0.5},
    "ground": {"slope": 2.0, "step": 0.6, "roughness": 0.5, "confidence": 0.5},
}
"""Limits that the ground of `chance_tile` stays within, so that traversability differs from cell to cell."""

FLAT = {
    "all": {"step": 0.5},
    "ground": {"step": 0.5, "confidence": 0.01},
}
"""Limits within which flat ground of two points a cell has no faults."""


def brute_traversability(m: RoughMap, level: int) -> dict[tuple[int, int], float]:
    """Return the least known traversability of the level-0 cells below each cell of a level."""
    limits = LENIENT[m.settings.surface]
    found: dict[tuple[int, int], float] = {}
    with m.freeze() as frozen:
        for x, y in frozen.tiles.tolist():
            plane = frozen.tile_layers(x, y, ["traversability"], limits=limits)["traversability"]
            for j, i in np.argwhere(np.isfinite(plane)).tolist():
                key = ((x * 64 + i) >> level, (y * 64 + j) >> level)
                found[key] = min(found.get(key, 1.0), float(plane[j, i]))
    return found


@pytest.mark.parametrize("level", [1, 2, 4])
def test_coarse_ground_is_never_safer_than_fine_ground(m: RoughMap, level: int) -> None:
    load(m, {(x, y): chance_tile(x + 5 * y + 50, 0.6) for x in (-3, -1, 0, 1) for y in (-2, -1, 0)})
    expected, limits = brute_traversability(m, level), LENIENT[m.settings.surface]
    assert 0.0 < min(expected.values()) < max(expected.values()) < 1.0
    with m.freeze(level=level) as frozen:
        known = 0
        for x, y in frozen.tiles.tolist():
            plane = frozen.tile_layers(x, y, ["traversability"], limits=limits)["traversability"]
            for j, i in np.argwhere(np.isfinite(plane)).tolist():
                assert plane[j, i] == expected[x * 64 + i, y * 64 + j]
                known += 1
    assert known == len(expected)


def test_coarse_traversability_follows_changes_beside_its_tiles(m: RoughMap) -> None:
    """A pit appears in the next tile: the cells along the border become bad in a merged tile that was read before."""
    put(m, *((i, j, 0.0) for i in range(60, 64) for j in range(4)))
    put(m, *((i, j, 0.0) for i in range(60, 64) for j in range(4)))
    limits = FLAT[m.settings.surface]

    def corner() -> float:
        with m.freeze(level=1, box=(0, 0, 0, 0)) as frozen:
            return float(frozen.tile_layers(0, 0, ["traversability"], limits=limits)["traversability"][0, 31])

    assert corner() == 1.0
    put(m, *[(64, 0, -1.0)] * 2)
    assert corner() == 0.0


def test_the_last_tile_below_a_level_tile_counts_for_its_neighbour(m: RoughMap) -> None:
    """The same across the border of two merged tiles: the ring of a sequence is counted in cells of its level."""
    put(m, *((i, j, 0.0) for i in range(120, 128) for j in range(4)))
    put(m, *((i, j, 0.0) for i in range(120, 128) for j in range(4)))
    limits = FLAT[m.settings.surface]

    def border() -> float:
        with m.freeze(level=1) as frozen:
            return float(frozen.tile_layers(0, 0, ["traversability"], limits=limits)["traversability"][0, 63])

    assert border() == 1.0
    put(m, *[(128, 0, -1.0)] * 2)
    assert border() == 0.0


def test_many_threads_read_one_frozen_map(m: RoughMap) -> None:
    load(m, {(x, y): chance_tile(x + 9 * y) for x in range(4) for y in range(4)})
    with m.freeze(level=2) as frozen:
        found: list[bytes] = []

        def read() -> None:
            plane = frozen.tile_layers(0, 0, ["traversability", "mean_height"])
            found.append(plane["traversability"].tobytes() + frozen.records(0, 0).tobytes())

        threads = [threading.Thread(target=read) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert len(found) == 6
        assert len(set(found)) == 1


@pytest.mark.parametrize(("surface", "room"), [("all", 22), ("ground", 33)])
def test_slopes_merge_each_tile_once(surface: str, room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache holds far fewer than all tiles: the neighbours of a tile are needed again with the next column.

    In a map of the ground it also keeps which cells are confirmed, 8 KiB for each of the 336 tiles of three levels, as
    much as 11 tiles take.
    """
    spread = np.arange(16) * 6.4 + 3.2
    x, y = (axis.ravel() for axis in np.meshgrid(spread, spread))
    rough_map = RoughMap(error_model="point", surface=surface, levels=3)
    rough_map.add(np.column_stack([x, y, 0 * x]))
    rough_map.limit_cache(room * 4096 * 64)
    merged: list[int] = []
    merge = levels.merge
    monkeypatch.setattr(levels, "merge", lambda children: merged.append(1) or merge(children))  # type: ignore[func-returns-value]
    with rough_map.freeze(2) as frozen:
        for tx, ty in frozen.tiles.tolist():
            frozen.tile_layers(tx, ty, ["slope"])
        assert len(frozen.tiles) == 16
    assert len(merged) == 64 + 16


def test_what_changed_alone_is_not_taken_for_the_whole(m: RoughMap) -> None:
    """Coarse cells made of the changed tiles alone share the cache, and their sequence, with those of all."""
    put(m, (0, 0, 1.0), (70, 0, 1.0))
    before = m.sequence
    put(m, (2, 0, 1.0))
    for level in (1, 2):
        with m.freeze(level, after=before) as changed, m.freeze(level) as whole:
            known = [frozen.known_cells(0, 0) for frozen in (changed, whole, changed)]
            assert known[0] == known[2] == known[1] - 1


def test_bad_levels(m: RoughMap) -> None:
    for level in (-1, 8):
        with pytest.raises(ValueError, match="level"):
            m.freeze(level=level)
