"""The truth of made worlds: height, passable, why not."""

import numpy as np
import pytest

from roughmap_service.simulation.ground import NODES, SPACING, Ground
from roughmap_service.simulation.solids import BOX, CYLINDER, SOLID, Solids, solid
from roughmap_service.simulation.truth import Truth, Why, truth
from roughmap_service.simulation.world import Mover, World

SIDE = 40
"""Cells of 0.1 m: the square from -2 to 2 m."""


def made(grid: np.ndarray | float = 0.0, *solids: Solids, movers: tuple[Mover, ...] = ()) -> World:
    ground = Ground.__new__(Ground)  # without waves and rocks; a truth needs the heights alone
    ground.grid = np.zeros((NODES, NODES)) + grid
    return World(ground, np.concatenate([np.empty(0, SOLID), *solids]), movers)


def seen(world: World, seconds: float = 0.0) -> Truth:
    return truth(world, seconds, (-2.0, -2.0), 0.1, (SIDE, SIDE))


def nodes() -> np.ndarray:
    index = np.arange(NODES)
    return np.where(index < NODES // 2, index, index - NODES) * SPACING


def test_flat_ground_is_passable_at_its_height() -> None:
    flat = seen(made(1.5))
    assert flat.passable.all()
    assert not flat.soft.any()
    # The mean of 25 equal numbers may err by a rounding or two.
    assert np.allclose(flat.height, 1.5, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("height", "blocked"), [(0.15, False), (0.25, True)])
def test_a_step_blocks_its_upper_side_as_far_as_a_wheel_reaches(height: float, blocked: bool) -> None:
    edge = seen(made(np.where(nodes() >= 0.0, height, 0.0)[None, :]))
    step = edge.why == Why.STEP
    assert step.any() == blocked
    if blocked:
        # The flank is one node wide, from -0.05 to 0 m: so the cell before 0 has a quarter of the height,
        # and the drop is a step from the two cells that reach beyond it.
        assert np.flatnonzero(step[20]).tolist() == [20, 21]
        assert (step == step[20]).all()
    assert edge.height[20, 30] == pytest.approx(height, abs=1e-12)


@pytest.mark.parametrize(("degrees", "why"), [(10, Why.PASSABLE), (28, Why.PASSABLE), (29, Why.SLOPE), (40, Why.STEP)])
def test_an_even_slope_is_judged_by_its_angle(degrees: float, why: Why) -> None:
    # The slope ends 30 m away, where the ground falls back.
    inclined = seen(made(np.clip(nodes(), -30, 30)[None, :] * np.tan(np.radians(degrees))))
    assert (inclined.why == why).all()


def test_what_stands_hangs_or_grows() -> None:
    world = made(
        0.0,
        solid(BOX, (-1.0, -1.0, 0.5), (0.25, 0.25, 0.5)),  # a crate
        solid(BOX, (1.0, -1.0, 2.4), (0.45, 0.45, 0.1)),  # a roof at 2.3 m
        solid(BOX, (-1.0, 1.0, 1.2), (0.45, 0.04, 0.05)),  # a beam at 1.2 m, thinner than a cell
        solid(CYLINDER, (1.0, 1.0, 0.3), (0.3, 0.3, 0.3), density=3.0, soft=True),  # a tuft of grass
        solid(BOX, (0.0, 0.0, 0.05), (0.1, 0.1, 0.05)),  # a board to drive over
    )
    found = seen(world)
    hit = found.why == Why.OBJECT
    crate = np.zeros_like(hit)
    crate[7:13, 7:13] = True  # -1.25 to -0.75 m touches the cells from -1.3 to -0.7 m
    beam = np.zeros_like(hit)
    beam[29:31, 5:15] = True
    assert np.array_equal(hit, crate | beam)
    assert np.array_equal(np.isnan(found.height), crate)
    assert found.passable[30, 30]
    assert found.soft[30, 30]
    assert not found.soft[~np.hypot(*np.indices(hit.shape) - 29.5).__lt__(5)].any()


def test_the_truth_is_that_of_its_time() -> None:
    person = Mover(
        ((0.0, -1.0, 0.0), (10.0, 1.0, 0.0), (20.0, 1.0, 9.0)), solid(CYLINDER, (0.0, 0.0, 0.8), (0.18, 0.18, 0.8))
    )
    world = made(0.0, movers=(person,))
    for seconds, x in ((0.0, -1.0), (5.0, 0.0), (10.0, 1.0)):
        columns = np.flatnonzero((seen(world, seconds).why == Why.OBJECT).any(axis=0))
        assert columns.mean() * 0.1 - 1.95 == pytest.approx(x, abs=1e-9)
    assert seen(world, 20.0).passable.all()
