"""Gradients, slope, steps and traversability, by hand, on planes with a halo of one cell."""

from math import atan, atan2, hypot, inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roughmap.reading.layers import check_limits
from roughmap.reading.terrain import coarsen_least, derive

SIDE = 0.5


def around(west: float, east: float, south: float, north: float, here: float = 1.0) -> np.ndarray:
    """Return one cell with its four nearest neighbours; rows along y."""
    return np.array([[nan, south, nan], [west, here, east], [nan, north, nan]])


def test_central_differences() -> None:
    ground = derive(around(west=0.9, east=1.3, south=1.6, north=1.2), SIDE)
    assert ground.gradient_x[0, 0] == pytest.approx(0.4)
    assert ground.gradient_y[0, 0] == pytest.approx(-0.4)
    assert ground.slope[0, 0] == pytest.approx(atan(hypot(0.4, 0.4)))
    assert ground.step_height[0, 0] == pytest.approx(0.6)


def test_one_sided_differences() -> None:
    ground = derive(around(west=nan, east=1.3, south=1.6, north=nan), SIDE)
    assert ground.gradient_x[0, 0] == pytest.approx(0.6)
    assert ground.gradient_y[0, 0] == pytest.approx(-1.2)


def test_an_axis_without_neighbours_is_unknown() -> None:
    ground = derive(around(west=0.9, east=1.3, south=nan, north=nan), SIDE)
    assert ground.gradient_x[0, 0] == pytest.approx(0.4)
    assert np.isnan(ground.gradient_y[0, 0])
    assert np.isnan(ground.slope[0, 0])
    assert ground.step_height[0, 0] == pytest.approx(0.3)


def test_an_unknown_cell_has_no_terrain() -> None:
    ground = derive(around(0.9, 1.3, 1.6, 1.2, here=nan), SIDE, check_limits(None), *(np.ones((1, 1)),) * 3)
    planes = (ground.gradient_x, ground.gradient_y, ground.slope, ground.step_height, ground.traversability)
    assert all(np.isnan(plane[0, 0]) for plane in planes)


def test_a_lone_cell_has_no_step() -> None:
    ground = derive(around(nan, nan, nan, nan), SIDE)
    assert np.isnan(ground.step_height[0, 0])


@pytest.mark.parametrize("place", [(0, 0), (0, 2), (2, 0), (2, 2), (0, 1), (1, 0)])
def test_a_step_to_any_of_the_eight(place: tuple[int, int]) -> None:
    mean = np.full((3, 3), 1.0)
    mean[place] = 0.25
    assert derive(mean, SIDE).step_height[0, 0] == 0.75


def test_a_tilted_plane_everywhere() -> None:
    """z = 0.3 x - 0.4 y has the gradient (0.3, -0.4) and the slope atan(0.5) in every cell."""
    y, x = np.mgrid[-1:6, -1:9] * SIDE
    ground = derive(0.3 * x - 0.4 * y, SIDE)
    assert ground.slope.shape == (5, 8)
    # the heights are below 5 m: differences over 1 m are exact to a few 1e-16
    np.testing.assert_allclose(ground.gradient_x, 0.3, rtol=0, atol=1e-14)
    np.testing.assert_allclose(ground.gradient_y, -0.4, rtol=0, atol=1e-14)
    np.testing.assert_allclose(ground.slope, atan(0.5), rtol=0, atol=1e-11)  # the layers' own arc tangent


def one(value: float) -> np.ndarray:
    return np.full((1, 1), value)


FLAT = np.ones((3, 3))
STEEP = np.array([[0.0, 0.5, 1.0]] * 3)
"""A gradient of 1 at a side of 0.5: a slope of 0.785, a step of 0.5."""


def traversability(
    mean: np.ndarray,
    limits: dict[str, float] | None,
    std_dev: float = 0.0,
    extent: float = 0.0,
    confidence: float = 1.0,
) -> float:
    planes = one(std_dev), one(extent), one(confidence)
    return float(derive(mean, SIDE, check_limits(limits), *planes).traversability[0, 0])


def test_flat_and_certain_ground_is_safe() -> None:
    assert traversability(FLAT, None) == 1.0


def test_each_term_alone() -> None:
    assert traversability(STEEP, {"slope": 1.0}) == pytest.approx(1 - atan2(1, 1))
    assert traversability(STEEP, {"step": 2.0}) == pytest.approx(0.75)
    assert traversability(FLAT, {"std_dev": 0.4}, std_dev=0.1) == pytest.approx(0.75)
    assert traversability(FLAT, {"range": 0.4}, extent=0.3) == pytest.approx(0.25)
    assert traversability(FLAT, {"confidence": 0.8}, confidence=0.2) == pytest.approx(0.25)


def test_the_least_term_counts_and_all_are_clipped() -> None:
    limits = {"std_dev": 0.4, "range": 0.4, "confidence": 0.8}
    assert traversability(FLAT, limits, std_dev=0.1, extent=0.3, confidence=1.0) == pytest.approx(0.25)
    assert traversability(FLAT, limits, std_dev=0.1, extent=9.0, confidence=1.0) == 0.0
    assert traversability(FLAT, {"confidence": 0.5}, confidence=1.0) == 1.0


def test_a_known_zero_precedes_unknown_terms() -> None:
    limits = {"slope": 0.5, "std_dev": 0.1, "range": 0.2}
    assert traversability(STEEP, limits, std_dev=nan) == 0.0
    assert traversability(FLAT, limits, std_dev=nan, extent=0.2) == 0.0
    assert np.isnan(traversability(FLAT, limits, std_dev=nan, extent=0.1))


def test_an_unknown_value_that_is_not_used_does_not_matter() -> None:
    assert traversability(FLAT, {"slope": 0.5}, std_dev=nan, extent=nan, confidence=nan) == 1.0
    alone = np.full((3, 3), nan)
    alone[1, 1] = 0.0
    assert np.isnan(traversability(alone, {"slope": 0.5}))
    assert traversability(alone, {"range": 0.5}) == 1.0


@given(
    values=hnp.arrays(np.float64, (4, 5), elements=st.sampled_from([nan, 0.0, 0.25, 0.9, 1.0, 2.0])),
    limits=st.dictionaries(
        st.sampled_from(["std_dev", "range", "confidence"]), st.sampled_from([0.5, 1.0]), min_size=1
    ),
)
def test_the_rule_of_the_least(values: np.ndarray, limits: dict[str, float]) -> None:
    planes = values, values[::-1].copy(), values[:, ::-1].copy()
    got = derive(np.ones((6, 7)), SIDE, check_limits(limits), *planes).traversability
    used = dict(zip(("std_dev", "range", "confidence"), planes, strict=True))
    for place, value in np.ndenumerate(got):
        ratios = [used[name][place] / limit for name, limit in limits.items()]
        parts = zip(limits, ratios, strict=True)
        terms = [nan if np.isnan(r) else min(max(r if name == "confidence" else 1 - r, 0.0), 1.0) for name, r in parts]
        expected = 0.0 if 0.0 in terms else (nan if any(np.isnan(t) for t in terms) else min(terms))
        np.testing.assert_equal(value, expected)


def test_planes_must_fit() -> None:
    with pytest.raises(ValueError, match="halo"):
        derive(np.ones(9), SIDE)
    with pytest.raises(ValueError, match=r"expected \(1, 1\)"):
        derive(FLAT, SIDE, (inf, inf, 0.1, inf, inf), np.ones((2, 2)))


def test_coarse_ground_is_as_bad_as_its_worst_known_child() -> None:
    south_west = np.array([[0.5, nan], [0.2, 0.9]])
    south_east = np.full((2, 2), nan)
    north_east = np.array([[nan, 0.0], [1.0, nan]])
    got = coarsen_least([south_west, south_east, None, north_east])
    np.testing.assert_equal(got, [[0.2, nan], [nan, 0.0]])
