"""Each equation of the method, with an example worked out by hand in the comments."""

from math import sqrt

import numpy as np
import pytest
from strategies import cells_of

from roughmap import Noise, RoughMap, Scan, Trajectory, georeference
from roughmap.reference.batch import BatchMap

HEIGHTS = (1.0, 2.0, 6.0)
"""Sum 9, mean 3, sum of squared differences 4 + 1 + 9 = 14."""


def cell_of_points(*heights: float, min_distance: float = 1e-3) -> RoughMap:
    """Return a map whose cell (0, 0), one metre wide, holds these heights as points without error."""
    m = RoughMap(cell_size=1.0, error_model="point", min_distance=min_distance, surface="all", threads=1)
    m.add([(0.5, 0.5, h) for h in heights])
    return m


def layer(m: RoughMap, name: str, tolerance: float = 0.05) -> float:
    return float(m.region((0, 0, 1, 1), [name], height_tolerance=tolerance)[name][0, 0])


def test_eq_1_georeferencing() -> None:
    """The robot stands at (10, 20, 5) and looks along the map's y; its scanner sits at (1, 0, 2), not rotated.

    A return 4 m ahead, (4, 0, 0), is at (5, 0, 2) in the robot's frame and at (10 - 0, 20 + 5, 5 + 2) in the map's.
    Levers: l = (0, 5, 2) from the base, l_m = (0, 4, 0) from the scanner.
    Scanner: sr = 0.02 + 0.0025 * 4 = 0.03 along y, st = 0.005 * 4 = 0.02 across: diag(4, 9, 4) e-4.
    Pose: x with variance 1e-4, yaw with 1e-4, both with covariance 2e-5. A yaw of 1 moves the point by
    (0, 0, 1) x l = (-5, 0, 0): xx gets 1e-4 + 25 * 1e-4 - 2 * 5 * 2e-5 = 24e-4.
    Mounting: x of the robot (y of the map) with 0.02: yy gets 4e-4. Pitch with 0.01 about the robot's y, which is the
    map's -x: (-1, 0, 0) x l_m = (0, 0, -4): zz gets 16 * 1e-4.
    """
    pose = np.zeros((1, 6, 6))
    pose[0, 0, 0] = pose[0, 5, 5] = 1e-4
    pose[0, 0, 5] = pose[0, 5, 0] = 2e-5
    trajectory = Trajectory([7], [(10, 20, 5)], [(0, 0, sqrt(0.5), sqrt(0.5))], pose)
    noise = Noise(0.02, 0.0025, 0.005, mount_sigma=(0.02, 0, 0, 0, 0.01, 0))
    points, covariance, reason, *_ = georeference(Scan([(4, 0, 0)], 7, translation=(1, 0, 2)), trajectory, noise)
    assert reason.tolist() == [0]
    np.testing.assert_allclose(points, [(10, 25, 7)], rtol=1e-15)
    # A rotation by 90 degrees is off by 1e-16, and so are the zeros.
    np.testing.assert_allclose(covariance[0], np.diag([28e-4, 13e-4, 20e-4]), rtol=1e-13, atol=1e-17)


def test_eq_2_mean() -> None:
    """(1 + 2 + 6) / 3 = 3."""
    assert layer(cell_of_points(*HEIGHTS), "mean_height") == pytest.approx(3.0, rel=1e-15)


def test_eq_3_mid_range() -> None:
    """(6 + 1) / 2 = 3.5."""
    assert layer(cell_of_points(*HEIGHTS), "mid_range_height") == 3.5


def test_eq_4_highest_and_lowest() -> None:
    m = cell_of_points(2.0, 6.0, 1.0)
    assert (layer(m, "max_height"), layer(m, "min_height")) == (6.0, 1.0)


def test_eq_5_running_mean() -> None:
    """1; 1 + (2 - 1) / 2 = 1.5; 1.5 + (6 - 1.5) / 3 = 3. Running m2: 0; 1 * 1/2 * 1^2 = 0.5; + 2 * 1/3 * 4.5^2 = 14."""
    for number, mean, m2 in ((1, 1.0, 0.0), (2, 1.5, 0.5), (3, 3.0, 14.0)):
        cell = cells_of(cell_of_points(*HEIGHTS[:number]))[0, 0]
        assert float(cell["mean"]) == pytest.approx(mean, rel=1e-15)
        assert float(cell["m2"]) == pytest.approx(m2, rel=1e-15)


def test_eq_6_standard_deviation() -> None:
    """sqrt(14 / (3 - 1))."""
    assert layer(cell_of_points(*HEIGHTS), "std_dev") == pytest.approx(sqrt(7.0), rel=1e-15)


def test_eq_6_at_survey_altitudes() -> None:
    """The same differences at 8848 m, in units of 1/1024 m, exact in float64: eq. 8 would lose them."""
    m = cell_of_points(*(8848.0 + h / 1024 for h in HEIGHTS))
    # Each running mean is off by up to 1e-12 m, 1e-9 of these differences.
    assert layer(m, "std_dev") == pytest.approx(sqrt(7.0) / 1024, rel=1e-8)


def test_eq_7_range() -> None:
    """6 - 1."""
    assert layer(cell_of_points(*HEIGHTS), "range") == 5.0


def test_eq_11_confidence_level() -> None:
    """With d = 2 std_dev / sqrt(3) the argument of F is 1: 2 F(1) - 1 = 0.682689492137086, one sigma's share."""
    m = cell_of_points(*HEIGHTS)
    # The layers' own error function is exact to 1e-10.
    assert layer(m, "confidence_level", 2 * sqrt(7 / 3)) == pytest.approx(0.682689492137086, abs=1e-10)


S_LOW = np.diag([0.05, 0.05, 0.05]) ** 2
S_HIGH = np.diag([0.05, 0.05, 0.10]) ** 2


def two_bodies(model: str) -> RoughMap:
    """Two points well inside a cell of 1 m: h = 1 with sigmas 0.05, h = 4 with 0.1 along z; k = 2."""
    m = RoughMap(cell_size=1.0, error_model=model, coverage=2.0, surface="all", threads=1)
    m.add([(0.5, 0.5, 1.0), (0.5, 0.5, 4.0)], np.stack([S_LOW, S_HIGH]))
    return m


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
def test_eq_14_weight(model: str) -> None:
    """p = 1 in both. cuboid: 1 / (0.1 * 0.1 * 0.1) = 1000, 1 / (0.1 * 0.1 * 0.2) = 500.

    ellipsoid: 1 / (2^3 * 0.05 * 0.05 * 0.05) = 1000, 1 / (2^3 * 0.05 * 0.05 * 0.1) = 500.
    W = 1500; W2 = 1000^2 + 500^2 = 1.25e6; m2 = 1000 * (500 / 1500) * (4 - 1)^2 = 3000;
    std_dev^2 = 3000 / (1500 - 1.25e6 / 1500) = 3000 / 666.67 = 4.5; n = 1500^2 / 1.25e6 = 1.8.
    """
    m = two_bodies(model)
    cell = cells_of(m)[0, 0]
    assert float(cell["weight"]) == pytest.approx(1500.0, rel=1e-14)
    assert float(cell["weight_sq"]) == pytest.approx(1.25e6, rel=1e-14)
    assert float(cell["m2"]) == pytest.approx(3000.0, rel=1e-14)
    assert layer(m, "std_dev") == pytest.approx(sqrt(4.5), rel=1e-14)
    assert layer(m, "expected_count") == pytest.approx(1.8, rel=1e-14)
    assert layer(m, "mean_variance") == pytest.approx(4.5 / 1.8, rel=1e-14)


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
def test_eq_13_weighted_mean(model: str) -> None:
    """1 + (4 - 1) * 500 / 1500 = 2."""
    assert layer(two_bodies(model), "mean_height") == pytest.approx(2.0, rel=1e-14)


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
def test_eq_14_half_a_point(model: str) -> None:
    """On the border x = 1 half lies on each side: w = 500 in each, W2 = w^2 / p = 500^2 / 0.5 = 500000, n = 0.5."""
    m = RoughMap(cell_size=1.0, error_model=model, surface="all", threads=1)
    m.add([(1.0, 0.5, 1.0)], S_LOW)
    for place in ((0, 0), (1, 0)):
        cell = cells_of(m)[place]
        assert float(cell["weight"]) == pytest.approx(500.0, rel=1e-14)
        assert float(cell["weight_sq"]) == pytest.approx(5e5, rel=1e-14)


def test_eq_14_of_a_tilted_ellipsoid() -> None:
    """[[5, 4, 0], [4, 5, 0], [0, 0, 4]] e-4 has the eigenvalues 9, 1, 4 e-4: 1 / (8 * 0.03 * 0.01 * 0.02)."""
    m = RoughMap(cell_size=1.0, error_model="ellipsoid", surface="all", threads=1)
    m.add([(0.5, 0.5, 1.0)], np.array([[5, 4, 0], [4, 5, 0], [0, 0, 4]]) * 1e-4)
    assert float(cells_of(m)[0, 0]["weight"]) == pytest.approx(1 / (8 * 6e-6), rel=1e-13)


def test_eq_15_confidence_factor() -> None:
    """Heights 0 and 3, least distance 1: means 0 and 1.5; 1 / (1 / 1^2 + 1 / 1.5^2) = 1 / (13 / 9), both methods."""
    m = cell_of_points(0.0, 3.0, min_distance=1.0)
    assert layer(m, "confidence_factor") == pytest.approx(9 / 13, rel=1e-15)
    b = BatchMap([(0.5, 0.5, 0.0), (0.5, 0.5, 3.0)], error_model="point", cell_size=1.0, min_distance=1.0)
    assert b["confidence_factor"][0] == pytest.approx(9 / 13, rel=1e-15)


def test_eq_16_running_confidence_factor() -> None:
    """1 / max(0, 1)^2 = 1; + 1 / 1.5^2 = 1 + 4/9; the third, 3, meets the mean 2: + 1 / max(1, 1)^2."""
    for number, inverse in ((1, 1.0), (2, 13 / 9), (3, 22 / 9)):
        cell = cells_of(cell_of_points(*(0.0, 3.0, 3.0)[:number], min_distance=1.0))[0, 0]
        assert float(cell["inv_cf"]) == pytest.approx(inverse, rel=1e-15)


@pytest.mark.parametrize("model", ["cuboid", "ellipsoid"])
def test_eq_16_weighted(model: str) -> None:
    """1000 / 0.001^2 = 1e9 by the least distance; + 500 / (4 - 2)^2 = 125."""
    assert float(cells_of(two_bodies(model))[0, 0]["inv_cf"]) == pytest.approx(1e9 + 125, rel=1e-14)


def test_equal_heights_spread_exactly_nothing() -> None:
    """0.1 is not exact in float64: the mean must still equal it exactly, and m2 be 0, after any number of points."""
    m = cell_of_points(*[0.1] * 1000)
    cell = cells_of(m)[0, 0]
    assert (float(cell["mean"]), float(cell["m2"]), layer(m, "std_dev")) == (0.1, 0.0, 0.0)
    assert layer(m, "confidence_level") == 1.0


def test_updated_is_the_newest_whole_second() -> None:
    """Stamps 7.9 s and 3.2 s give 7; a later call with 5 s does not lower it."""
    m = RoughMap(cell_size=1.0, error_model="point", surface="all", threads=1)
    m.add([(0.5, 0.5, 0), (0.5, 0.5, 0)], stamp_ns=[7_900_000_000, 3_200_000_000])
    m.add([(0.5, 0.5, 0), (1.5, 0.5, 0)], stamp_ns=5_000_000_000)
    cells = cells_of(m)
    assert (int(cells[0, 0]["updated"]), int(cells[1, 0]["updated"])) == (7, 5)
    with m.freeze() as frozen:
        assert frozen.stamps(0, 0) == (3_200_000_000, 7_900_000_000)
    np.testing.assert_array_equal(m.region((0, 0, 2, 1), ["age"])["age"], [[0.0, 2.0]])
