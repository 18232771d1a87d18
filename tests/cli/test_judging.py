"""The arithmetic of the demo's table, on arrays."""

import numpy as np
import pytest

from roughmap_service.cli.demo.judging import judge
from roughmap_service.cli.demo.steps import judgement_rows
from roughmap_service.simulation.truth import Truth, Why

SIDE = 20


def true_world() -> Truth:
    """Flat ground with a wall of one row, a step of one row, and grass in a corner."""
    why = np.zeros((SIDE, SIDE), dtype=np.int8)
    height = np.zeros((SIDE, SIDE))
    why[10], height[10] = Why.OBJECT, np.nan
    why[15] = Why.STEP
    soft = np.zeros((SIDE, SIDE), dtype=np.bool_)
    soft[:4, :4] = True
    return Truth(height, why, soft)


def perfect() -> np.ndarray:
    return np.where(true_world().passable, 1.0, 0.0)


def test_a_perfect_map() -> None:
    found = judge(true_world(), 0.1, perfect(), np.zeros((SIDE, SIDE)), np.full((SIDE, SIDE), 0.01))
    assert (found.cells, found.known, found.blocked, found.free) == (400, 400, 40, 400 - 6 * SIDE)
    assert (found.wrongly_free, found.wrongly_forbidden, found.wrongly_forbidden_hard) == (0.0, 0.0, 0.0)
    assert (found.height_error_median_m, found.height_error_p95_m, found.covered) == (0.0, 0.0, 1.0)


def test_an_obstacle_a_cell_aside_is_right_and_two_are_not() -> None:
    for aside, wrong in ((1, 0.0), (2, 0.5)):
        score = perfect()
        score[10], score[10 + aside] = 1.0, 0.0
        assert judge(true_world(), 0.1, score, np.zeros((SIDE, SIDE))).wrongly_free == wrong
    score = perfect()
    score[11], score[12] = 0.0, 0.0  # beside the wall; row 12 has none of it next to it
    assert judge(true_world(), 0.1, score, np.zeros((SIDE, SIDE))).wrongly_forbidden == SIDE / (400 - 6 * SIDE)


def test_a_step_at_unknown_ground_is_not_judged_but_an_object_is() -> None:
    score = np.full((SIDE, SIDE), 0.5)
    score[:, 10:] = np.nan
    found = judge(true_world(), 0.1, score, np.where(np.isnan(score), np.nan, 0.0))
    # 10 cells of the wall, and of the step the 7 from which 0.3 m to the unknown remain.
    assert (found.known, found.blocked, found.wrongly_free) == (200, 17, 1.0)


def test_grass_is_told_apart() -> None:
    score = perfect()
    score[:4, :4] = 0.0
    found = judge(true_world(), 0.1, score, np.zeros((SIDE, SIDE)))
    assert found.wrongly_forbidden == 16 / (400 - 6 * SIDE)
    assert found.wrongly_forbidden_hard == 0.0


def test_heights_and_their_interval() -> None:
    height = np.zeros((SIDE, SIDE))
    height[0], height[1] = 0.02, -0.5
    height[2] = np.nan
    height[10] = 1.5  # on the wall: nothing to compare
    interval = np.full((SIDE, SIDE), 0.03)
    interval[3] = np.nan
    found = judge(true_world(), 0.1, perfect(), height, interval)
    assert found.known == 380
    assert found.height_error_median_m == 0.0
    assert found.height_error_p95_m == 0.5  # one row of 18 is off: more than 5 %
    assert found.covered == pytest.approx(16 / 17)
    assert judge(true_world(), 0.1, perfect(), height).covered is None


def test_nothing_known_has_no_rows() -> None:
    nothing = np.full((SIDE, SIDE), np.nan)
    found = judge(true_world(), 0.1, nothing, nothing, nothing)
    assert found.known == 0
    assert judgement_rows(found) == []


def test_the_rows_fit_a_terminal() -> None:
    rows = dict(judgement_rows(judge(true_world(), 0.1, perfect(), np.zeros((SIDE, SIDE)), np.ones((SIDE, SIDE)))))
    assert rows["wrongly free"] == "0.00% of 40 blocked cells"
    assert rows["95 % interval"] == "holds the true height in 100.0% of the cells"
    assert max(len(value) for value in rows.values()) + len("memory of the service  ") <= 80
