"""Edges of the map: 32-bit cell numbers, `bounds`, huge coordinates, and their effect on footprints."""

import threading
from math import inf, nextafter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, WEIGHTED, cell_boxes, cells_of

from roughmap import RoughMap
from roughmap.cell import TRUST_DTYPE
from roughmap.integration.workspace import Workspace
from roughmap.tiles.state import TileState

TOP, BOTTOM = 2.0**31, -(2.0**31)
SMALL = np.eye(3) * 1e-6
"""Two sigmas are 2 mm."""


@pytest.mark.parametrize("axis", [0, 1])
def test_the_first_and_the_last_cell(axis: int) -> None:
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    inside = [BOTTOM, nextafter(BOTTOM, 0), BOTTOM + 1, nextafter(TOP, 0), TOP - 1]
    outside = [nextafter(BOTTOM, -inf), TOP, TOP + 1, 1e18, -1e18, 1e300, -1e308, 1.7e308]
    points = np.full((len(inside) + len(outside), 3), 0.5)
    points[:, axis] = inside + outside
    report = m.add(points)
    assert (report.accepted, report.rejected) == (len(inside), {"bounds": len(outside)})
    found = {place[axis]: int(cell["count"]) for place, cell in cells_of(m).items()}
    assert found == {-(2**31): 2, -(2**31) + 1: 1, 2**31 - 1: 2}
    assert {place[1 - axis] for place in cells_of(m)} == {0}


@pytest.mark.parametrize("model", WEIGHTED)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("end", [BOTTOM, TOP])
def test_a_footprint_that_leaves_the_numbers(model: str, axis: int, end: float) -> None:
    """A body of half width 0.25 fits at 0.375 from the last border, but not at 0.125."""
    inwards = 1.0 if end < 0 else -1.0
    for distance, rejected in ((0.375, {}), (0.125, {"bounds": 1})):
        m = RoughMap(cell_size=1.0, error_model=model, threads=1)
        point = np.full((1, 3), 0.5)
        point[0, axis] = end + inwards * distance
        assert m.add(point, np.eye(3) * 0.125**2).rejected == rejected


def test_all_levels_at_the_corners_of_the_numbers() -> None:
    """Four corners, four tiles at every level; numbers do not wrap, so none is a neighbour of another."""
    m = RoughMap(cell_size=1.0, error_model="point", levels=26, threads=1)
    corners = [(x, y, 1.0) for x in (BOTTOM, TOP - 1) for y in (BOTTOM, TOP - 1)]
    for n, corner in enumerate(corners):
        m.add([corner], stamp_ns=n)
    for level in range(26):
        low, high = -(1 << 25 >> level), (1 << 25 >> level) - 1
        with m.freeze(level) as frozen:
            assert frozen.tiles.tolist() == [[low, low], [low, high], [high, low], [high, high]]
            # Only at the last level but one are the tiles neighbours.
            if level < 25:
                assert frozen.sequences.tolist() == [1, 2, 3, 4]
    assert m.extent() == (BOTTOM, BOTTOM, TOP, TOP)


def test_the_cell_of_a_point_is_a_division_not_a_product() -> None:
    """0.3 / 0.1 is 2.9999999999999996, while 0.3 * 10 is 3; -0.0 lies in cell 0, the float below it in cell -1."""
    m = RoughMap(cell_size=0.1, error_model="point", threads=1)
    m.add([(0.3, -0.0, 0.0), (0.6, -5e-324, 0.0)])
    assert set(cells_of(m)) == {(2, 0), (5, -1)}


@pytest.mark.parametrize("model", MODELS)
def test_bounds_are_half_open(model: str) -> None:
    m = RoughMap(cell_size=0.25, error_model=model, bounds=(-1.0, 0.5, 2.0, 3.0), threads=1)
    inside = [(-1.0, 0.5), (nextafter(2.0, 0), 0.5), (-1.0, nextafter(3.0, 0))]
    outside = [(nextafter(-1.0, -2), 1.0), (2.0, 1.0), (0.0, nextafter(0.5, 0)), (0.0, 3.0), (1e300, 1.0)]
    report = m.add([(*place, 0.0) for place in inside + outside], SMALL)
    assert (report.accepted, report.rejected) == (3, {"bounds": 5})
    i, j = zip(*cells_of(m), strict=True)
    assert (min(i), max(i), min(j), max(j)) == (-4, 7, 2, 11)


@pytest.mark.parametrize("model", WEIGHTED)
@examples(100)
@given(box=cell_boxes(), place=st.tuples(st.floats(-1, 7), st.floats(-1, 7)), turn=st.floats(-0.9, 0.9))
def test_footprint_cells_outside_are_not_written(
    model: str, box: tuple[int, int, int, int], place: tuple[float, float], turn: float
) -> None:
    """Inside the bounds each cell has the same bytes as in a map without bounds."""
    i0, j0, i1, j1 = box
    a = 0.25
    point = [((i0 + place[0]) * a, (j0 + place[1]) * a, 1.0)]
    S = np.array([[1, turn, 0], [turn, 1, 0], [0, 0, 1]]) * 0.2**2
    free = RoughMap(cell_size=a, error_model=model, threads=1)
    free.add(point, S)
    fenced = RoughMap(cell_size=a, error_model=model, bounds=(i0 * a, j0 * a, i1 * a, j1 * a), threads=1)
    report = fenced.add(point, S)
    inside = i0 * a <= point[0][0] < i1 * a and j0 * a <= point[0][1] < j1 * a
    assert (report.accepted, report.rejected) == ((1, {}) if inside else (0, {"bounds": 1}))
    expected = {(i, j): cell for (i, j), cell in cells_of(free).items() if i0 <= i < i1 and j0 <= j < j1}
    found = cells_of(fenced)
    assert found.keys() == (expected.keys() if inside else set())
    assert all(cell.tobytes() == expected[where].tobytes() for where, cell in found.items())
    assert {tuple(tile) for tile in report.tiles.tolist()} == {(i >> 6, j >> 6) for i, j in found}


def test_a_bound_meant_to_lie_on_a_border_does() -> None:
    """0.3 / 0.1 is below 3: without the slack of 1e-6 cells a column outside would be written."""
    m = RoughMap(cell_size=0.1, error_model="cuboid", bounds=(0.3, 0.0, 0.6, 0.7), min_share=0.0, threads=1)
    m.add([(0.31, 0.35, 0.0), (0.59, 0.35, 0.0)], np.eye(3) * 0.02**2)
    assert {i for i, _ in cells_of(m)} == {3, 5}


@pytest.mark.parametrize("model", WEIGHTED)
def test_a_body_finer_than_the_floats_there(model: str) -> None:
    """At 1e8 m floats are 1.5e-8 apart: a body of 1e-9 m lies in one cell, with share 1 and its exact height."""
    m = RoughMap(cell_size=0.1, error_model=model, min_radius=1e-9, threads=1)
    assert m.add([(1e8, -1e8, 3.0)], np.zeros((3, 3))).accepted == 1
    ((place, cell),) = cells_of(m).items()
    assert place == (int(np.floor(1e8 / 0.1)), int(np.floor(-1e8 / 0.1)))
    assert (int(cell["count"]), float(cell["mean"])) == (1, 3.0)
    assert float(cell["weight"] ** 2 / cell["weight_sq"]) == pytest.approx(1.0, rel=1e-14)


def test_counts_stop_at_the_top() -> None:
    """A count of 2^32 - 1 does not wrap to 0, which would make the cell unknown."""
    m = RoughMap(cell_size=1.0, error_model="point", threads=1)
    m.add([(0.5, 0.5, 1.0)])
    with m.freeze() as frozen:
        records = frozen.records(0, 0).reshape(-1).copy()
    records[0]["count"] = 2**32 - 2
    other = RoughMap(cell_size=1.0, error_model="point", threads=1)
    other.load_tile(0, 0, TileState(records, np.zeros(4096, TRUST_DTYPE), None), 0, 0)
    for count in (2**32 - 1, 2**32 - 1):
        other.add([(0.5, 0.5, 1.0)])
        assert int(cells_of(other)[0, 0]["count"]) == count


def test_heights_of_any_size() -> None:
    """Heights near the end of float64 are finite points: the cell must not become NaN in mean, min and max."""
    m = RoughMap(cell_size=1.0, error_model="point", surface="all", threads=1)
    m.add([(0.5, 0.5, 1e150), (0.5, 0.5, 1e150), (1.5, 0.5, -1e150), (1.5, 0.5, 1e150)])
    cells = cells_of(m)
    assert float(cells[0, 0]["mean"]) == 1e150
    assert float(cells[1, 0]["mean"]) == 0.0
    assert (float(cells[1, 0]["min"]), float(cells[1, 0]["max"])) == (-1e150, 1e150)


@pytest.mark.parametrize("model", MODELS)
def test_no_ground_is_higher_than_10_000_km(model: str) -> None:
    """The heights of bins are 32-bit numbers of 10 cm."""
    m = RoughMap(cell_size=1.0, error_model=model, threads=1)
    heights = np.array([1e7, -1e7, nextafter(1e7, inf), nextafter(-1e7, -inf), 1e150, -1e300])
    points = np.column_stack([np.arange(6) + 0.5, np.full(6, 0.5), heights])
    report = m.add(points, SMALL)
    assert (report.accepted, report.rejected) == (2, {"bounds": 4})
    assert {place: float(cell["mean"]) for place, cell in cells_of(m).items()} == {(0, 0): 1e7, (1, 0): -1e7}


@pytest.mark.parametrize("height", [1e4, 1e6, 1e9, 1e12, 1e20, 1e100])
def test_a_body_that_raising_widens_is_no_covariance(height: float) -> None:
    """Eigenvalues down to -1e-9 of the trace are accepted; raising them can widen a high body without limit."""
    m = RoughMap(error_model="ellipsoid", max_vertical_sigma=np.inf, threads=1)
    S = np.diag([0.01, 0.01, height])
    S[0, 2] = np.sqrt((0.01 + 0.9e-9 * height) * height)
    report = m.add(np.array([[1.0, 1.0, 0.0]]), S)
    assert report.accepted + report.rejected.get("covariance", 0) == 1
    assert report.accepted == (height < 1e7)
    cells = [i for i, _ in cells_of(m)]
    assert not cells or max(cells) - min(cells) < m.settings.side


def test_a_part_that_fails_leaves_no_other_at_work() -> None:
    """The next scan uses the same memory."""
    entered, leave = threading.Event(), threading.Event()
    working = []

    def task(part: int, _: object) -> None:
        if part == 1:
            raise MemoryError
        if part == 2:
            working.append(part)
            entered.set()
            assert leave.wait(20)
            working.remove(part)
        else:
            assert entered.wait(20)
            threading.Timer(0.05, leave.set).start()

    space = Workspace(3, 4)
    with pytest.raises(MemoryError):
        space.run(3, task)
    assert not working
    space.close()
