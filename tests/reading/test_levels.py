"""Merging four cells into one: by hand, and against a map built at the coarser cell size."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from read_tools import TILE_SHAPE, cell_of, chance_tile, tile_of
from two_methods import over_cells

from roughmap.cell import CELL_DTYPE, TRUST_DTYPE
from roughmap.map import RoughMap
from roughmap.reading.levels import merge, merge_flags, merge_trust

CHILDREN = ((0, 0), (1, 0), (0, 1), (1, 1))


def merged(children: list[np.ndarray | None]) -> np.ndarray:
    """Return the parent of four cells, each a record or None for unknown."""
    known = {place: child for place, child in zip(CHILDREN, children, strict=True) if child is not None}
    return merge([tile_of(known), None, None, None])[0, 0]


def test_a_lone_child_is_copied_to_the_bit() -> None:
    lone = cell_of([0.1, 0.7, 0.3], [0.3, 0.2, 0.9], updated=11)
    for place in range(4):
        children: list[np.ndarray | None] = [None] * 4
        children[place] = lone
        assert merged(children).tobytes() == lone.tobytes()


def test_two_children_by_hand() -> None:
    """Heights 1, 3 and 6: mean 10/3 and m2 = 49/9 + 1/9 + 64/9 = 38/3."""
    got = merged([cell_of([1.0, 3.0], updated=5), None, None, cell_of([6.0], updated=3)])
    assert (got["count"], got["updated"], got["weight"], got["weight_sq"]) == (3, 5, 3.0, 3.0)
    assert got["mean"] == pytest.approx(10 / 3)
    assert got["m2"] == pytest.approx(38 / 3)
    assert (got["min"], got["max"]) == (1.0, 6.0)
    assert got["inv_cf"] == pytest.approx(3e6)


def test_nothing_known_below() -> None:
    assert merge([None, tile_of({}), None, None]).tobytes() == bytes(np.prod(TILE_SHAPE) * 64)


def test_counts_stop_at_the_top() -> None:
    many = cell_of([1.0, 2.0])
    many["count"] = 2**32 - 2
    assert merged([many, many, None, None])["count"] == 2**32 - 1
    one = cell_of([1.0])
    assert merged([many, one, None, None])["count"] == 2**32 - 1
    assert merged([many, one, one, one])["count"] == 2**32 - 1


def test_each_quadrant_from_its_child() -> None:
    """Cell (i, j) of the parent is merged from (2i, 2j) and its three neighbours, over all four child tiles."""
    tiles = [chance_tile(seed) for seed in range(4)]
    got = merge(tiles)
    below = np.block([[tiles[0], tiles[1]], [tiles[2], tiles[3]]])
    for name, how in (("count", np.sum), ("updated", np.max), ("weight", np.sum), ("inv_cf", np.sum)):
        blocks = below[name].reshape(64, 2, 64, 2)
        np.testing.assert_allclose(got[name], how(blocks, axis=(1, 3)), rtol=1e-15)
    # a missing tile is a tile of unknown cells
    tiles[2] = np.zeros(TILE_SHAPE, CELL_DTYPE)
    assert merge(tiles).tobytes() == merge([tiles[0], tiles[1], None, tiles[3]]).tobytes()
    assert not got.flags.writeable


@given(
    st.lists(
        st.lists(st.tuples(st.integers(-1000, 1000), st.integers(1, 64)), max_size=3),
        min_size=4,
        max_size=4,
    )
)
def test_the_merge_is_that_of_all_points_at_once(points: list[list[tuple[int, int]]]) -> None:
    """Heights and weights are binary fractions, so that the true sums are exact."""
    children = [cell_of((h / 8 for h, _ in cell), (w / 8 for _, w in cell)) if cell else None for cell in points]
    got = merged(children)
    every = [(Fraction(h, 8), Fraction(w, 8)) for cell in points for h, w in cell]
    if not every:
        assert got["count"] == 0
        return
    weight = sum(w for _, w in every)
    mean = sum(w * h for h, w in every) / weight
    # mean and m2 pass through at most 12 additions and three merges of numbers up to 125 and 125^2 * 24
    assert got["weight"] == weight
    assert got["mean"] == pytest.approx(float(mean), rel=1e-14, abs=1e-12)
    assert got["m2"] == pytest.approx(float(sum(w * (h - mean) ** 2 for h, w in every)), rel=1e-12, abs=1e-9)
    assert got["weight_sq"] == sum(w * w for _, w in every)
    assert (got["min"], got["max"]) == (min(h for h, _ in every), max(h for h, _ in every))
    assert got["count"] == len(every)


def test_sigmas_of_trust_are_averaged_by_weight() -> None:
    """Weights 1 and 3, sigmas 1 and 2 cm: 1.75 cm. A lone child keeps its trust; unknown children don't count."""
    cells = tile_of({(0, 0): cell_of([0.0]), (1, 1): cell_of([0.0], [3.0]), (2, 0): cell_of([1.0])})
    trust = np.zeros(TILE_SHAPE, TRUST_DTYPE)
    trust[0, 0] = 1e-4, 5.0, 0.01, 0.1, 77
    trust[1, 1] = 4e-4, 5.0, 0.03, 0.2, 78
    trust[0, 1] = 9.0, 9.0, 9.0, 9.0, 9
    trust[0, 2] = 3e-5, 1.0, 2e-5, 0.3, 7
    got = merge_trust([cells, None, None, None], [trust, None, None, None])
    assert not got.flags.writeable
    assert got[0, 0]["variance"] == pytest.approx(0.0175**2, rel=1e-6)
    assert got[0, 0]["pose_variance"] == pytest.approx(0.025, rel=1e-6)
    assert got[0, 0]["mount_sigma"] == pytest.approx(0.175, rel=1e-6)
    assert (got[0, 0]["shared"], got[0, 0]["stamp_ms"]) == (0.0, 0)
    assert got[0, 1]["variance"] == pytest.approx(np.float32(3e-5), rel=1e-7)
    assert (got[0, 1]["pose_variance"], got[0, 1]["mount_sigma"]) == (np.float32(2e-5), np.float32(0.3))
    assert got[1:].tobytes() == got[0, 2:].tobytes() + bytes(got[1:].nbytes - got[0, 2:].nbytes)


def test_a_cell_is_confirmed_if_a_child_is() -> None:
    flags = np.zeros((64, 64), np.uint16)
    flags[5, 7] = flags[4, 6] = flags[63, 63] = 1
    got = merge_flags([None, flags.reshape(-1, 1), None, None]).reshape(64, 64)
    assert np.argwhere(got).tolist() == [[2, 32 + 3], [31, 63]]


def grown_map(model: str, side: float, levels: int, seed: int) -> tuple[RoughMap, np.ndarray]:
    """Return a map of ground around the origin, built with the paper's min_share of 0."""
    rng = np.random.default_rng(seed)
    points = np.column_stack((rng.uniform(-9.0, 9.0, (4000, 2)), rng.normal(300.0, 0.3, 4000)))
    spread = rng.uniform(0.01, 0.05, (4000, 3))
    mix = rng.uniform(-0.8, 0.8, 4000) * spread[:, 0] * spread[:, 1]
    covariance = np.zeros((4000, 3, 3))
    covariance[:, [0, 1, 2], [0, 1, 2]] = spread**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = mix
    stamp_ns = rng.integers(0, 10**12, 4000)
    m = RoughMap(cell_size=side, error_model=model, surface="all", min_share=0.0, levels=levels, threads=1)
    m.add(points, None if model == "point" else covariance, stamp_ns)
    return m, points


@pytest.mark.parametrize("model", ["point", "cuboid", "ellipsoid"])
def test_a_level_is_the_map_built_at_that_cell_size(model: str) -> None:
    """W, W2, mean, m2, min, max and `updated` agree; the count only for `point`, where no point lies in two cells.

    In the coarser map the weights are two, four and eight times as large, since eq. 14 contains the side of the cell,
    and W2 four, sixteen and sixty-four times.
    """
    side = 0.125
    fine, _ = grown_map(model, side, 4, seed=1)
    for level in (1, 2, 3):
        coarse, _ = grown_map(model, side * 2**level, 1, seed=1)
        scale = 1.0 if model == "point" else 2.0**level
        with fine.freeze(level=level) as merged_tiles, coarse.freeze() as direct:
            np.testing.assert_array_equal(merged_tiles.tiles, direct.tiles)
            assert merged_tiles.cell_size == direct.cell_size
            for x, y in direct.tiles.tolist():
                a, b = merged_tiles.records(x, y), direct.records(x, y)
                np.testing.assert_array_equal(a["count"] > 0, b["count"] > 0)
                for name in ("min", "max", "updated"):
                    np.testing.assert_array_equal(a[name], b[name])
                # Shares carry the rounding of coordinates over radii, 1e-15 / 1e-2, of which a sliver is a difference:
                # 1e-9 of the heaviest cell is far above that, far below any point's real share.
                heaviest = b["weight"].max()
                np.testing.assert_allclose(a["weight"] * scale, b["weight"], rtol=1e-9, atol=1e-12 * heaviest)
                squares = b["weight_sq"].max()
                np.testing.assert_allclose(a["weight_sq"] * scale**2, b["weight_sq"], rtol=1e-9, atol=1e-12 * squares)
                whole = b["weight"] > 1e-6 * heaviest
                np.testing.assert_allclose(a["mean"][whole], b["mean"][whole], rtol=0, atol=1e-8)
                np.testing.assert_allclose(a["m2"] * scale, b["m2"], rtol=1e-8, atol=1e-10 * heaviest)
                if model == "point":
                    np.testing.assert_array_equal(a["count"], b["count"])
                else:
                    assert (a["count"] >= b["count"]).all()


def test_the_region_of_a_level_counts_each_point_once_with_point() -> None:
    fine, points = grown_map("point", 0.125, 8, seed=2)
    cells = np.unique(np.floor(points[:, :2] / 16.0).astype(int), axis=0)
    layers, known = over_cells(fine, cells, ["count"], level=7)
    assert layers["count"].sum() == len(points)
    assert known == len(cells) == 4
