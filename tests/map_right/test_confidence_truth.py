"""The stated confidence holds: a short run of the simulation, and its own formulas against the map's records."""

import numpy as np
import pytest
from confidence import rows_of
from confidence_map import mapped
from confidence_running import run
from confidence_scene import POSES, scene

from roughmap.points.footprint import ERROR_MODELS

TILES = 200

OFF = 0.03
"""What is allowed of the statement itself."""

CHANCE = 0.06
"""Cells of a tile share its poses' errors, so that 200 tiles tell a share to 0.03 or so; two strata of a hundred may be
off by twice that."""


@pytest.mark.parametrize("model", ["point", "cuboid"])
@pytest.mark.parametrize("poses", POSES)
def test_the_records_agree_with_formulas_of_their_own(model: str, poses: str) -> None:
    """Trust is kept in float32: a hundred updates leave 1e-5 of it."""
    truth = scene(1, "smooth", poses, 20)
    kept, formulas = mapped(truth, model, "all"), run(truth, model)
    for name in ("tile", "i", "j", "count"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(formulas, name), err_msg=name)
    for name in ("W", "W2", "mean", "m2"):
        np.testing.assert_allclose(getattr(kept, name), getattr(formulas, name), rtol=1e-9, atol=1e-15, err_msg=name)
    for name in ("V", "C", "M"):
        np.testing.assert_allclose(getattr(kept, name), getattr(formulas, name), rtol=1e-4, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("ground", ["smooth", "rough"])
@pytest.mark.parametrize("poses", [name for name in POSES if name != "two robots at once"])
def test_stated_intervals_hold(poses: str, ground: str) -> None:
    truth = scene(2, ground, poses, TILES)
    for model in ERROR_MODELS:
        for row in rows_of(truth, mapped(truth, model), (model, poses, ground)):
            assert abs(row.covered - row.stated) <= OFF + CHANCE, row


def test_two_robots_at_once_are_believed_too_little_not_too_much() -> None:
    """A cell does not know whose pose its last point had: it takes errors of two robots for one and the same. Of many
    cells, a stated half then holds for two thirds."""
    truth = scene(2, "smooth", "two robots at once", TILES)
    for row in rows_of(truth, mapped(truth, "cuboid"), ("cuboid", "two robots at once", "smooth")):
        assert -OFF - CHANCE <= row.covered - row.stated <= 0.16 + CHANCE, row


def test_the_paper_s_confidence_does_not_hold() -> None:
    """It takes the points of a scan for independent: the test must be able to fail."""
    truth = scene(2, "smooth", "correlated", TILES)
    rows = rows_of(truth, mapped(truth, "cuboid"), ("cuboid", "correlated", "smooth"))
    assert np.nanmin([row.paper - row.stated for row in rows]) < -0.5


def test_a_pose_error_time_too_short_is_found_out() -> None:
    """Robots that declare that they forget their errors in a tenth of the time."""
    truth = scene(2, "smooth", "correlated", TILES)
    truth = truth._replace(poses=truth.poses._replace(time=0.5))
    rows = rows_of(truth, mapped(truth, "cuboid"), ("cuboid", "correlated", "smooth"))
    assert min(row.covered - row.stated for row in rows) < -0.1
