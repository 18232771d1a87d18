"""What makes coordinates doubtful, and what does not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service.formats.doubts import NO_DATA, Doubts, no_data, without_no_data
from roughmap_service.formats.recorded import Floats, PlacedPoints

RNG = np.random.default_rng(8)


def doubts(places: Floats, cell_size: float = 0.1) -> list[str]:
    collected = Doubts()
    for begin in range(0, len(places), 7):
        collected.take(places[begin : begin + 7])
    return collected.found(cell_size)


def survey(rows: int = 500) -> Floats:
    return RNG.uniform((698362.12, 5949119.37, 55), (698392.12, 5949149.37, 85), (rows, 3))


@pytest.mark.parametrize("value", [*NO_DATA, -3.4028234663852886e38, 1e30])
def test_placeholders_are_left_out(value: float) -> None:
    points = survey(5)
    points[3, 2] = value
    points[1, 0] = np.nan  # counted as not finite by the map
    assert no_data(points).tolist() == [False, False, False, True, False]
    covariance = np.arange(45.0).reshape(5, 3, 3)
    kept = without_no_data(PlacedPoints(points, np.arange(5), covariance))
    assert np.array_equal(kept.points, points[[0, 1, 2, 4]], equal_nan=True)
    assert np.array_equal(kept.stamp_ns, [0, 1, 2, 4])
    assert kept.covariance is not None
    assert np.array_equal(kept.covariance, covariance[[0, 1, 2, 4]])


def test_deep_ground_and_coordinates_are_kept() -> None:
    assert not no_data(np.array([[-9999.0, -9999.0, -9998.0], [0, -32768, -410.5], [0, 0, -999.5]])).any()


def test_float32_of_survey_coordinates() -> None:
    (said,) = doubts(survey().astype(np.float32).astype(np.float64))
    assert said.startswith("steps in x of 0.0625 m and in y of 0.5 m are too coarse for cells of 0.1 m")
    (said,) = doubts(survey().astype(np.float32).astype(np.float64), cell_size=1.0)
    assert said.startswith("steps in y of 0.5 m are too coarse")
    assert not doubts(survey().astype(np.float32).astype(np.float64), cell_size=5.0)


@pytest.mark.parametrize(
    "places",
    [
        survey(),
        np.round(survey(), 2),
        np.floor(survey()),  # a grid of 1 m
        np.floor(survey()) + 0.5,
        (RNG.uniform(-50, 50, (500, 3))).astype(np.float32).astype(np.float64),
        np.full((500, 3), 5949119.5),
        np.empty((0, 3)),
        np.full((40, 3), np.nan),
    ],
    ids=["float64", "two decimals", "grid", "centres", "near 0", "one place", "none", "not finite"],
)
def test_what_holds_the_cell_size(places: Floats) -> None:
    assert not doubts(places)


@given(
    longitude=st.floats(-179, 178).filter(lambda v: abs(v) > 3),
    latitude=st.floats(-80, 80),
    side=st.floats(1e-5, 0.5),
    relief=st.floats(0.5, 50),
    seed=st.integers(0, 1000),
)
@examples(60)
def test_degrees(longitude: float, latitude: float, side: float, relief: float, seed: int) -> None:
    relief = max(relief, 12 * side)  # 1 m on 10 km is flat ground
    unit = np.vstack([np.zeros(3), np.ones(3), np.random.default_rng(seed).uniform(0, 1, (30, 3))])
    (said,) = doubts(unit * (side, side, relief) + (longitude, latitude, 100))
    assert said.startswith("this looks like degrees")


@given(
    place=st.tuples(*[st.floats(-80, 80)] * 2), side=st.floats(1, 80), relief=st.floats(0, 1), seed=st.integers(0, 99)
)
@examples(60)
def test_metres_are_no_degrees(place: tuple[float, float], side: float, relief: float, seed: int) -> None:
    """Nothing that is less than ten times as high as wide is doubted."""
    unit = np.vstack([np.zeros(3), np.ones(3), np.random.default_rng(seed).uniform(0, 1, (30, 3))])
    assert not doubts(unit * (side, side, 9 * side * relief) + (*place, 0))
