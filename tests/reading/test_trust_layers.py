"""Intervals and confidences from cells and their trust: by hand, at the limits of the numbers, and in odd tiles."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from read_tools import TILE_SHAPE, cell_of, chance_tile, tile_of
from scipy import stats

from roughmap import RoughMap
from roughmap.cell import CELL_DTYPE, TRUST_DTYPE
from roughmap.reading.layers import TRUST_LAYERS
from roughmap.reading.trust import trust_layers

NO_TRUST = np.zeros(TILE_SHAPE, TRUST_DTYPE)


def read(cells: np.ndarray, trust: np.ndarray = NO_TRUST, tolerance: float = 0.05) -> dict[str, np.ndarray]:
    return trust_layers(cells, trust, TRUST_LAYERS, tolerance)


def within(t: float, freedom: float) -> float:
    return 1.0 - 2.0 * float(stats.t.sf(t, freedom))


def test_one_point_is_as_sure_as_ground_is_rough() -> None:
    """3 cm with two degrees of freedom; common errors of 4 cm make 5 cm, and 2 (25 / 9)^2 degrees."""
    trust = NO_TRUST.copy()
    trust["variance"][0, 1], trust["mount_sigma"][0, 1] = 0.0007, 0.03
    got = read(tile_of({(0, 0): cell_of([1.0]), (1, 0): cell_of([1.0])}), trust)
    assert got["mean_sigma"][0, :2] == pytest.approx([0.03, 0.05])
    freedom = 2.0 * (25.0 / 9.0) ** 2
    assert got["interval_95"][0, 0] == pytest.approx(0.03 * stats.t.isf(0.025, 2.0), rel=4e-6)
    assert got["interval_95"][0, 1] == pytest.approx(0.05 * stats.t.isf(0.025, freedom), rel=4e-6)
    assert got["confidence"][0, :2] == pytest.approx([within(5 / 6, 2.0), within(0.5, freedom)], abs=4e-5)
    assert got["local_confidence"][0, :2] == pytest.approx([within(5 / 6, 2.0)] * 2, abs=4e-5)


def test_scatter_that_the_poses_explain_is_not_roughness() -> None:
    """Four points, m2 / W = 0.01: s^2 is the weighted mean of 0.0009 (2 degrees) and 0.04 / 3 (3 degrees)."""
    rough = cell_of([-0.1, 0.1, -0.1, 0.1])
    trust = NO_TRUST.copy()
    trust["pose_variance"][0, 1] = 0.01
    got = read(tile_of({(0, 0): rough, (1, 0): rough}), trust)
    assert got["mean_sigma"][0, 0] == pytest.approx(math.sqrt((2 * 0.0009 + 0.04) / 5 / 4))
    part = (0.0009 / (0.0009 + 0.04 / 3)) ** 2
    assert got["mean_sigma"][0, 1] == pytest.approx(math.sqrt(2 * 0.0009 / (2 + part * 3) / 4), rel=1e-5)


def test_points_on_the_border_leave_some_of_the_roughness() -> None:
    """n = 1 of two points: ne = 1.5, and 5 % of half of s^2 stay."""
    cell = cell_of([0.0, 0.0])
    cell["weight_sq"] = cell["weight"] ** 2
    got = read(tile_of({(0, 0): cell}))
    variance = 2 * 0.0009 / 2.5
    assert got["mean_sigma"][0, 0] == pytest.approx(math.sqrt(variance * (1 / 1.5 + 0.05 * 0.5)))


@pytest.mark.parametrize(("number", "variance"), [(19, 0.0009), (20, 0.0004)])
def test_cells_of_few_points_borrow_from_the_tile(number: int, variance: float) -> None:
    """Twenty cells of eight points and 2 cm are enough to know the tile by: four degrees instead of two."""
    spread = 0.02 * math.sqrt(7 / 8)
    smooth = {(i, 5): cell_of([-spread, spread] * 4) for i in range(number)}
    got = read(tile_of(smooth | {(40, 40): cell_of([2.0])}))
    assert got["mean_sigma"][40, 40] == pytest.approx(math.sqrt(variance))
    freedom = 4.0 if number >= 20 else 2.0
    assert got["local_confidence"][40, 40] == pytest.approx(within(0.025 / math.sqrt(variance), freedom), abs=4e-5)


def test_a_tile_is_never_smoother_than_5_mm_and_its_median_is_the_lower_one() -> None:
    flat = {(i, 5): cell_of([1.0] * 8) for i in range(20)}
    assert read(tile_of(flat | {(40, 40): cell_of([2.0])}))["mean_sigma"][40, 40] == pytest.approx(0.005)
    spread = 0.03 * math.sqrt(7 / 8)
    for number, sigma in ((20, 0.005), (21, 0.03)):
        rough = {(i, 6): cell_of([-spread, spread] * 4) for i in range(number)}
        got = read(tile_of(flat | rough | {(40, 40): cell_of([2.0])}))
        assert got["mean_sigma"][40, 40] == pytest.approx(sigma)


def test_nothing_known() -> None:
    assert all(np.isnan(plane).all() for plane in read(np.zeros(TILE_SHAPE, CELL_DTYPE)).values())


BIG = st.floats(0.0, float(np.finfo(np.float32).max), width=32)
WEIGHTS = st.floats(1e-120, 1e120)


@examples(60)
@given(
    st.lists(
        st.tuples(st.integers(1, 2**32 - 1), WEIGHTS, st.floats(1e-6, 1.0), st.floats(0.0, 1e14), BIG, BIG, BIG),
        min_size=1, max_size=64,
    ),
    st.floats(1e-9, 1e9),
)  # fmt: skip
def test_never_nan_in_a_known_cell(cells: list[tuple[float, ...]], tolerance: float) -> None:
    tile, trust = np.zeros(TILE_SHAPE, CELL_DTYPE), NO_TRUST.copy()
    for i, (count, weight, part, spread, variance, pose, mount) in enumerate(cells):
        tile[0, i]["count"], tile[0, i]["weight"] = count, weight
        tile[0, i]["weight_sq"] = weight * weight / max(count * part, 1.0)
        tile[0, i]["m2"] = weight * spread
        trust[0, i] = variance, 0.0, pose, mount, 0
    with np.errstate(over="ignore"):
        got = read(tile, trust, tolerance)
    own = {name: plane[0, : len(cells)] for name, plane in got.items()}
    assert not any(np.isnan(plane).any() for plane in own.values())
    assert (own["mean_sigma"] > 0.0).all()
    # student_95 is good to 3e-6 of its least value
    assert (own["interval_95"] >= 1.9599 * own["mean_sigma"]).all()
    for name in ("confidence", "local_confidence"):
        assert ((own[name] >= 0.0) & (own[name] <= 1.0)).all()
    # the same deviate at more degrees of freedom: less only by what the approximation is off by
    assert (own["confidence"] <= own["local_confidence"] + 4e-5).all()


@given(st.sampled_from([np.nan, np.inf]), st.sampled_from(["variance", "pose_variance", "mount_sigma"]))
def test_trust_that_overflowed_says_nothing(value: float, name: str) -> None:
    trust = NO_TRUST.copy()
    trust[name] = value
    got = read(chance_tile(1, 1.0), trust)
    assert np.isinf(got["mean_sigma"]).all()
    assert np.isinf(got["interval_95"]).all()
    assert (got["confidence"] == 0.0).all()
    assert not np.isnan(got["local_confidence"]).any()


@examples(10)
@given(st.integers(0, 10**6), st.sampled_from(["point", "cuboid", "ellipsoid"]), st.sampled_from(["all", "ground"]))
def test_every_known_cell_of_every_map_has_them(seed: int, model: str, surface: str) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack((rng.uniform(-3.0, 3.0, (3000, 2)), rng.normal(200.0, 0.05, 3000)))
    covariance = np.eye(3) * rng.uniform(1e-6, 1e-2)
    with RoughMap(error_model=model, surface=surface, threads=1) as m:
        m.add(points, covariance, 10**9, common=rng.uniform(0.0, 1e-2), mount=1e-4)
        for level in (0, 2):
            region = m.region((-3.0, -3.0, 3.0, 3.0), ["mean_height", *TRUST_LAYERS], level=level)
            known = np.isfinite(region["mean_height"])
            assert known.any()
            for name in TRUST_LAYERS:
                assert np.isfinite(region[name][known]).all(), name
                assert np.isnan(region[name][~known]).all(), name
