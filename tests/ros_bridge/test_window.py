"""Which cells a topic of the map shows."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap_ros.out.window import Window, window
from roughmap_schemas.ros2_sections import Ros2OutConfig

PLACES = st.floats(-1e6, 1e6)
SIZES = st.floats(0.1, 50)


def out(**settings: object) -> Ros2OutConfig:
    return Ros2OutConfig.model_validate({"type": "GridMap", **settings})


def test_a_box_is_the_cells_that_it_covers() -> None:
    assert window(out(box=(-1.0, 0.0, 2.0, 0.3)), 0.1, None) == Window(-10, 0, 30, 3, 0.1)
    assert window(out(box=(0.05, 0.05, 0.06, 0.06)), 0.1, None) == Window(0, 0, 1, 1, 0.1)


def test_a_level_has_cells_twice_as_large() -> None:
    assert window(out(box=(-1.0, 0.0, 2.0, 1.0), level=2), 0.1, None) == Window(-3, 0, 8, 3, 0.4)


def test_without_a_position_there_is_no_window_around_a_robot() -> None:
    assert window(out(), 0.1, None) is None


@given(
    x=PLACES, y=PLACES, cell=st.sampled_from([0.05, 0.1, 0.25]), size=st.tuples(st.floats(0.1, 50), st.floats(0.1, 50))
)
def test_a_robot_is_within_a_cell_of_the_middle_of_its_window(
    x: float, y: float, cell: float, size: tuple[float, float]
) -> None:
    found = window(out(size=size), cell, (x, y))
    assert found is not None
    assert max(abs(found.centre[0] - x), abs(found.centre[1] - y)) <= 0.5001 * cell
    assert [found.nx, found.ny] == pytest.approx([math.ceil(one / cell) for one in size], abs=1)


@given(x=st.integers(-(10**7), 10**7), n=st.integers(1, 400), side=st.sampled_from([0.1, 0.3, 1 / 3]))
def test_a_query_for_a_window_has_its_cells_and_no_others(x: int, n: int, side: float) -> None:
    low, _, high, _ = Window(x, 0, n, 1, side).asked
    assert (math.floor(low / side), math.floor(high / side)) == (x, x + n - 1)
