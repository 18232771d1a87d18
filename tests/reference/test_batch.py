"""The batch builder: the contract's worked cells, ellipse shares against exact areas, what it refuses."""

from itertools import pairwise
from math import atan2, pi, sqrt

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from roughmap.reference.batch import BatchMap
from roughmap.reference.batch_shares import cells_of_bodies

POINTS = np.array([(0.57, -0.22, 10.00), (0.56, -0.24, 10.03), (0.61, -0.25, 9.98)])
ROUND = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-4
COVARIANCES = np.stack([ROUND, ROUND, np.diag([1.0, 1.0, 4.0]) * 1e-4])

WORKED = {
    "point": {
        "cells": [(5, -3), (6, -3)],
        "count": 2,
        "weight": 2,
        "mean_height": 10.015,
        "confidence_factor": 9.95575221239e-7,
        "std_dev": 0.0212132034356,
        "expected_count": 2,
        "confidence_level": 0.904419295454,
    },
    "cuboid": {
        "cells": [(5, -3), (5, -2), (6, -3), (6, -2)],
        "count": 3,
        "weight": 4513.88888889,
        "mean_height": 10.0046153846,
        "confidence_factor": 8.13514923946e-10,
        "std_dev": 0.0460023501162,
        "expected_count": 1.28030303030,
        "confidence_level": 0.461390349327,
    },
    "ellipsoid": {
        "cells": [(5, -3), (5, -2), (6, -3)],
        "count": 3,
        "weight": 4492.0263065,
        "mean_height": 10.0071248174,
        "confidence_factor": 7.13277040073e-10,
        "std_dev": 0.0394773740989,
        "expected_count": 1.38718675324,
        "confidence_level": 0.544249981940,
    },
}


@pytest.mark.parametrize("model", WORKED)
def test_the_worked_cell(model: str) -> None:
    b = BatchMap(POINTS, COVARIANCES, error_model=model)
    expected = dict(WORKED[model])
    assert [tuple(cell) for cell in b.cells.tolist()] == expected.pop("cells")
    assert (b.accepted, b.rejected) == (3, {})
    place = b.cells.tolist().index([5, -3])
    for name, value in expected.items():
        assert b[name][place] == pytest.approx(value, rel=1e-11), name  # twelve digits are given
    assert b["min_height"][place] == (10.0 if model == "point" else 9.98)
    assert b["max_height"][place] == 10.03


def test_the_cumulative_sums_of_the_confidence_factor() -> None:
    """Heights 0, 3, 3 with weight 1: means 0, 1.5, 2, distances (at least 1) 1, 1.5, 1: 1 + 1 / 2.25 + 1."""
    b = BatchMap([(0.05, 0.05, h) for h in (0.0, 3.0, 3.0)], error_model="point", min_distance=1.0)
    assert b["confidence_factor"][0] == pytest.approx(1 / (2 + 1 / 2.25))


def test_cells_do_not_disturb_each_other() -> None:
    """The layers of a cell are the same alone and beside a cell of millions of times its weight."""
    heavy, light = np.diag([1e-8, 1e-8, 1e-8]), np.diag([0.01, 0.01, 0.2])
    points = np.array([(-0.5, 0.5, 7.0), (-0.4, 0.4, 7.1), (1.5, 0.5, 1.0), (1.5, 0.4, 1.3), (1.4, 0.5, 1.1)])
    covariances = np.stack([heavy, heavy, light, light, light])
    both = BatchMap(points, covariances, cell_size=1.0, error_model="cuboid")
    alone = BatchMap(points[2:], light, cell_size=1.0, error_model="cuboid")
    assert both.cells.tolist() == [[-1, 0], [1, 0]]
    for name in ("mean_height", "std_dev", "confidence_factor", "weight"):
        assert both[name][1] == alone[name][0]


def test_gradients_and_steps_between_cells() -> None:
    heights = {(0, 0): 1.0, (1, 0): 1.2, (2, 0): 1.6, (1, 1): 0.9}
    b = BatchMap([(i + 0.5, j + 0.5, h) for (i, j), h in heights.items()], error_model="point", cell_size=1.0)
    place = {tuple(cell): n for n, cell in enumerate(b.cells.tolist())}
    assert b["gradient_x"][place[1, 0]] == pytest.approx(0.3)
    assert b["gradient_x"][place[0, 0]] == pytest.approx(0.2)
    assert b["gradient_y"][place[1, 0]] == pytest.approx(-0.3)
    assert np.isnan(b["gradient_y"][place[0, 0]])
    assert np.isnan(b["gradient_x"][place[1, 1]])
    assert b["step_height"][place[1, 1]] == pytest.approx(0.7)
    assert b["slope"][place[1, 0]] == pytest.approx(np.arctan(0.3 * sqrt(2)))


def test_the_least_cell_number_has_no_neighbour_beyond_32_bits() -> None:
    lowest, highest = -(2**31) + 0.5, 2**31 - 0.5
    b = BatchMap([(0.5, lowest, 1.0), (-0.5, highest, 5.0)], error_model="point", cell_size=1.0)
    assert b.cells.tolist() == [[-1, 2**31 - 1], [0, -(2**31)]]
    assert np.isnan(b["step_height"]).all()


def beneath_edge(a: np.ndarray, b: np.ndarray) -> float:
    """The signed area that the edge from a to b spans with the origin within the unit disc.

    Inside the disc that is a triangle, outside a sector; their signed sum over a polygon's edges is the area of the
    polygon within the disc (Green's theorem).
    """
    length = float(np.hypot(*(b - a)))
    if length == 0.0:
        return 0.0
    along = (b - a) / length
    foot, off = -float(a @ along), float(a[0] * along[1] - a[1] * along[0])
    half = sqrt(max(0.0, (1.0 - off) * (1.0 + off)))  # of the chord that the edge's line cuts from the disc

    def at(place: float) -> np.ndarray:
        return a if place <= 0.0 else b if place >= length else a + place * along  # an end as given, not rounded

    enter, leave = at(foot - half), at(foot + half)

    def sector(p: np.ndarray, q: np.ndarray) -> float:
        return atan2(p[0] * q[1] - p[1] * q[0], p @ q) / 2

    return sector(a, enter) + (enter[0] * leave[1] - enter[1] * leave[0]) / 2 + sector(leave, b)


def ellipse_in(left: float, right: float, bottom: float, top: float, rho: float) -> float:
    """The share of the ellipse u^2 - 2 rho u v + v^2 <= 1 - rho^2 in a rectangle of the (u, v) plane.

    (u, (v - rho u) / sqrt(1 - rho^2)) maps the ellipse to the unit disc and the rectangle to a parallelogram.
    """
    beta = sqrt((1 - rho) * (1 + rho))
    corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
    mapped = [np.array([u, (v - rho * u) / beta]) for u, v in corners]
    return sum(beneath_edge(a, b) for a, b in pairwise(mapped)) / pi


def test_the_exact_reference() -> None:
    """Areas that are known: a quarter, a half with one side through the centre, a segment, all, nothing."""
    far = 50.0
    for rho in (0.0, 0.7, -0.999):
        quarter = ellipse_in(0.0, far, 0.0, far, rho)
        assert quarter == pytest.approx(0.25 + np.arcsin(rho) / (2 * pi), abs=1e-12)  # of a normal's orthant, too
        assert ellipse_in(-far, 0.0, -far, far, rho) == pytest.approx(0.5, abs=1e-12)
        assert ellipse_in(0.5, far, -far, far, rho) == pytest.approx((pi / 3 - sqrt(3) / 4) / pi, abs=1e-12)
        assert ellipse_in(-1.0, 1.0, -1.0, 1.0, rho) == pytest.approx(1.0, abs=1e-12)
        assert ellipse_in(1.0, far, -far, far, rho) == pytest.approx(0.0, abs=1e-12)
    small = 2 * 0.1 * 2 * 0.2 / pi  # a rectangle inside the circle
    assert ellipse_in(-0.1, 0.1, -0.2, 0.2, 0.0) == pytest.approx(small, abs=1e-15)


@example(middle=(0.0, 1e-18), sigma=(1.0, 1.0), rho=6e-8)
@example(middle=(0.0, 0.0), sigma=(3.0, 1e-3), rho=0.999)
@example(middle=(0.5, 0.5), sigma=(0.5, 0.5), rho=0.0)
@given(
    middle=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    sigma=st.tuples(st.floats(1e-3, 3.0), st.floats(1e-3, 3.0)),
    rho=st.floats(-0.999, 0.999),
)
def test_ellipse_shares_add_up_and_are_exact(
    middle: tuple[float, float], sigma: tuple[float, float], rho: float
) -> None:
    """All cells, of side 1. In units of sigma their corners lie up to 2000 from the middle, in the plane of the disc up
    to 2000 / sqrt(1 - rho^2) < 45,000. Rounding moves an edge there by at most 45,000 * 2^-52 = 1e-11, and the area by
    at most half the circumference times that: 1e-11 of pi. The product rounds on the same scale, so the two may differ
    by 2e-11. (20,000 random and degenerate ellipses differed by at most 2e-13.)"""
    points = np.array([(*middle, 0.0)])
    pairs, _ = cells_of_bodies(points, np.array([sigma]), np.array([rho]), np.ones(1), 1.0, 0.0)
    # shares up to 1e-12 are left out, in at most 64 cells
    assert pairs.share.sum() == pytest.approx(1.0, abs=1e-10)
    for i, j, share in zip(pairs.i.tolist(), pairs.j.tolist(), pairs.share.tolist(), strict=True):
        left, right = ((i + k - middle[0]) / sigma[0] for k in (0, 1))
        bottom, top = ((j + k - middle[1]) / sigma[1] for k in (0, 1))
        assert share == pytest.approx(ellipse_in(left, right, bottom, top, rho), abs=2e-11), (i, j)


def test_what_is_rejected() -> None:
    nan = np.nan
    ok = np.diag([1e-4, 1e-4, 1e-4])
    cases = {
        "not_finite": [((nan, 0, 0), ok), ((0, 0, np.inf), ok)],
        "covariance": [
            ((0, 0, 0), np.diag([1e-4, nan, 1e-4])),
            ((0, 0, 0), np.diag([1e-4, -1e-9, 1e-4])),
            ((0, 0, 0), [[1e-4, 2e-4, 0], [0, 1e-4, 0], [0, 0, 1e-4]]),
        ],
        "uncertain": [((0, 0, 0), np.diag([1e-4, 0.0626, 1e-4]))],
        "bounds": [((2, 0, 0), ok), ((0, -2.001, 0), ok), ((1e300, 0, 0), ok)],
    }
    points = [point for rows in cases.values() for point, _ in rows]
    covariances = np.array([covariance for rows in cases.values() for _, covariance in rows])
    b = BatchMap(points, covariances, bounds=(-2, -2, 2, 2))
    assert b.accepted == 0
    assert b.rejected == {name: len(rows) for name, rows in cases.items()}
    assert len(b.cells) == 0
    assert b["traversability"].shape == (0,)


def test_the_lower_triangle_is_not_read() -> None:
    upper = np.array([[1e-4, 5e-5, 0], [np.nan, 1e-4, 0], [np.nan, np.nan, 1e-4]])
    whole = np.array([[1e-4, 5e-5, 0], [5e-5, 1e-4, 0], [0, 0, 1e-4]])
    a, b = (BatchMap([(0.1, 0.1, 1.0)], s, error_model="ellipsoid") for s in (upper, whole))
    assert a.rejected == {}
    np.testing.assert_array_equal(a["weight"], b["weight"])


def test_cells_beyond_the_bounds_are_not_written() -> None:
    """The point's rectangle reaches over two borders; the quarter inside keeps its share of the whole."""
    S = np.diag([0.01, 0.01, 0.01])
    free = BatchMap([(0.0, 0.0, 1.0)], S, cell_size=0.5)
    fenced = BatchMap([(0.0, 0.0, 1.0)], S, cell_size=0.5, bounds=(0.0, 0.0, 3.0, 3.0))
    assert free.cells.tolist() == [[-1, -1], [-1, 0], [0, -1], [0, 0]]
    assert fenced.cells.tolist() == [[0, 0]]
    assert fenced["weight"][0] == free["weight"][3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([(1, 2)], np.eye(3)), r"\(N, 3\)"),
        (([(1, 2, 3)],), "covariance"),
        (([(1, 2, 3)], np.eye(2)), "covariance"),
        (([(1, 2, 3)], np.eye(3), -1), "stamp"),
        (([(1, 2, 3)], np.eye(3), 2**32 * 10**9), "stamp"),
        (([(1, 2, 3)], np.eye(3), [1, 2]), "stamp"),
        (([(1, 2, 3)], np.eye(3), 0.5), "stamp"),
    ],
)
def test_bad_arguments(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BatchMap(*arguments)


def test_an_unknown_model() -> None:
    with pytest.raises(ValueError, match="sphere"):
        BatchMap([(0, 0, 0)], error_model="sphere")
