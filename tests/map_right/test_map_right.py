"""The judges of the map, judged: do they see what is wrong, and is the simulated scanner's world what it says?"""

import math

import numpy as np
import pytest
import right_placements
from right_cast import Axes, Block, Post, Scanner, Slab, cast
from right_hall import plane
from right_maps import Grid, Seen, grid
from right_person import put_in
from right_row import Row, lines
from right_strays import with_strays
from scipy.spatial.transform import Rotation

ORIGIN = np.array([0.0, 0.0, 1.0])
HERE = Axes(0.0, (0.0, 0.0, 0.0))


def beam(*direction: float) -> np.ndarray:
    return np.array([direction]) / np.linalg.norm(direction)


@pytest.mark.parametrize(
    ("shape", "direction", "range_"),
    [
        (Slab(), (0, 0, -1), 1.0),
        (Slab(), (1, 0, -1), math.sqrt(2.0)),
        (Slab(), (1, 0, 0), math.inf),
        (Slab(0.0, (1.0, 0.0)), (1, 0, 0), 1.0),
        (Block((2, -1, 0), (3, 1, 2)), (1, 0, 0), 2.0),
        (Block((2, -1, 0), (3, 1, 2)), (-1, 0, 0), math.inf),
        (Block((2, -1, 0), (3, 1, 2)), (1, 1, 0), math.inf),
        (Post(3, 0, 0.5, 0, 2), (1, 0, 0), 2.5),
        (Post(3, 0, 0.5, 0, 0.9), (1, 0, 0), math.inf),
    ],
)
def test_beams_meet_shapes(shape: Slab | Block | Post, direction: tuple[float, ...], range_: float) -> None:
    assert shape.meet(ORIGIN, beam(*direction))[0] == pytest.approx(range_)


def test_a_sweep_lies_on_what_it_sees() -> None:
    """Flat ground, by a scanner that is turned and tilted: the points lie on it but for the ranges' noise."""
    rng = np.random.default_rng(1)
    turned = Rotation.from_euler("zyx", [0.4, 0.1, -0.1])
    points = cast([Slab()], ORIGIN, turned, Scanner(), rng)
    returned = (points != 0.0).any(axis=1)
    assert 0.3 < returned.mean() < 0.7
    heights = (turned.apply(points[returned]) + ORIGIN)[:, 2]
    assert np.abs(heights.mean()) < 0.001
    assert 0.001 < heights.std() < 0.01


def test_axes_go_there_and_back() -> None:
    axes = Axes(0.7, (3.0, -2.0, 1.0))
    x, y, _ = axes.rotation.apply([[5.0, 1.0, 0.0]])[0] + axes.shift
    back = axes.local(np.array(x), np.array(y))
    assert [float(v) for v in back] == pytest.approx([5.0, 1.0])


@pytest.fixture
def field() -> Seen:
    """All of it free."""
    cells = grid((-3.0, -3.0, 3.0, 3.0))
    flat = np.zeros(cells.x.shape)
    return Seen(cells, flat + 0.9, flat, flat)


LINE = right_placements.Placement([], 0.0, 0.0)


def test_a_free_field_is_crossed(field: Seen) -> None:
    assert right_placements.crossed(field, HERE, LINE)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_wall_of_forbidden_or_unknown_cells_is_not_crossed(field: Seen, value: float) -> None:
    field.traversability[np.abs(field.grid.x) < 0.06] = value
    assert not right_placements.crossed(field, HERE, LINE)


def test_a_gap_wide_enough_for_the_robot_is_crossed_and_a_narrow_one_is_not(field: Seen) -> None:
    wall = np.abs(field.grid.x) < 0.06
    field.traversability[wall & (np.abs(field.grid.y) > 0.11)] = 0.0
    assert not right_placements.crossed(field, HERE, LINE)
    field.traversability[wall & (np.abs(field.grid.y) < 0.35)] = 0.9
    assert right_placements.crossed(field, HERE, LINE)


def test_the_floors_plane_is_found_under_a_hall() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-10.0, 10.0, (20_000, 2))
    floor = np.column_stack([xy, xy @ [0.04, -0.01] - 1.6 + rng.normal(0.0, 0.01, 20_000)])
    above = np.column_stack([xy[:8000], rng.uniform(-1.0, 4.0, 8000)])
    assert plane(np.concatenate([floor, above])) == pytest.approx([0.04, -0.01, -1.6], abs=0.002)


def test_strays_lie_on_their_beams() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(0.0, 1.0, (10_000, 3)) * 5.0
    moved = with_strays(points, 0.01, True, rng)
    changed = (moved != points).any(axis=1)
    before, after = (np.linalg.norm(p[changed], axis=1) for p in (points, moved))
    assert changed.sum() == pytest.approx(0.01 * len(points), rel=0.02)
    assert moved[changed] / after[:, None] == pytest.approx(points[changed] / before[:, None])
    assert (after >= 0.5).all()
    assert (after <= 1.5 * before).all()
    assert 0.4 < (after < before).mean() < 0.6


def test_a_person_hides_what_is_behind() -> None:
    wall = np.column_stack([np.full(400, 6.0), np.linspace(-3.0, 3.0, 400), np.zeros(400)])
    seen, own = put_in(wall, np.eye(4), np.array([3.0, 0.0]), -1.0, np.random.default_rng(4))
    assert 0 < own.sum() < 100
    assert np.abs(np.hypot(seen[own, 0] - 3.0, seen[own, 1]) - 0.25).max() < 0.1
    assert (seen[~own] == wall[~own]).all()


def test_grid_counts_points_in_their_cells() -> None:
    cells: Grid = grid((-0.2, 0.0, 0.2, 0.2))
    assert cells.x.shape == (2, 4)
    counted = cells.hits(np.array([[-0.15, 0.05], [-0.11, 0.09], [0.15, 0.15], [0.25, 0.15], [0.0, -0.01]]))
    assert counted.tolist() == [[2, 0, 0, 0], [0, 0, 0, 1]]


def test_what_was_not_measured_is_missed() -> None:
    rows = [Row("a", "b", "%", 0.5, 0.5), Row("a", "c", "%", 94.9, 95.0, least=True), Row("a", "d", "%", math.nan, 1.0)]
    assert [row.met for row in rows] == [True, False, False]
    assert lines(rows)[-1] == "1 of 3 marks are met."


@pytest.mark.parametrize("draw", right_placements.ACROSS.values(), ids=lambda draw: draw.__name__)
def test_nothing_across_the_way_is_missed(draw: right_placements.Draw) -> None:
    """A few draws of each; `make map-right` tries 200."""
    assert right_placements.missed(draw, "ground", "cuboid", 7, 3) == []


def test_flat_ground_is_crossed_and_a_roof_forbids_nothing() -> None:
    assert right_placements.missed(right_placements.nothing, "ground", "cuboid", 7, 3) == [0, 1, 2]
    assert right_placements.roof_forbidden("ground", "cuboid", 7, 3) == []


def test_slopes_are_right() -> None:
    forbidden, off = right_placements.slopes("ground", "cuboid", 7, 3)
    assert forbidden == []
    assert off.max() < 0.2
