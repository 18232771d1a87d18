"""How two maps differ, in numbers that can be told by hand."""

import math

import numpy as np
import pytest

from roughmap import RoughMap
from roughmap_service.offline.compare import LayerDifference, compare

COVARIANCE = np.eye(3) * 1e-8
"""So precise that a point in the middle of a cell touches no other."""


def make(cell_size: float, points: list[tuple[float, float, float]], surface: str = "all") -> RoughMap:
    """A map of these points, each of which makes its cell known."""
    rough_map = RoughMap(cell_size=cell_size, surface=surface)
    if points:
        rough_map.add(np.array(points), COVARIANCE, 0)
    return rough_map


def of(layer: str, before: RoughMap, now: RoughMap) -> LayerDifference:
    """What `compare` says of one layer."""
    (found,) = (difference for difference in compare(before, now) if difference.layer == layer)
    return found


def test_a_map_beside_itself() -> None:
    points = [(0.05, 0.05, 0.1), (0.15, 0.05, 0.3), (-7.05, 3.05, 0.2)]
    for d in compare(make(0.1, points), make(0.1, points)):
        assert (d.only_before, d.only_now) == (0, 0)
        if d.layer in ("mean_height", "count", "weight"):
            assert (d.cells, d.median_change, d.p95_abs_change) == (3, 0.0, 0.0)


def test_what_is_unknown_in_one_of_them_is_only_in_the_other() -> None:
    """Three cells hold points, but a lone return makes no known ground, and a roof 3 m over a ground is none."""
    points = [(0.05, 0.05, 0.1), (0.05, 0.05, 0.1), (0.25, 0.05, 3.1), (0.25, 0.05, 3.1), (-7.05, 3.05, 0.2)]
    ground = make(0.1, points, "ground")
    found = of("mean_height", make(0.1, points), ground)
    assert (found.cells, found.only_before, found.only_now) == (1, 2, 0)
    found = of("count", ground, make(0.1, points, "ground"))
    assert (found.cells, found.only_before, found.only_now) == (1, 0, 0)
    assert {d.layer for d in compare(ground, ground)} >= {"roughness", "passable_share"}


def test_heights_and_what_only_one_of_them_knows() -> None:
    """Three places that both know, at changes of +0.1, -0.2 and +0.4 m; two only before, one only now."""
    before = make(0.1, [(0.05, 0.05, 0.0), (0.15, 0.05, 0.0), (9.05, 0.05, 1.0), (0.25, 0.05, 5.0), (50.05, 0.05, 5.0)])
    now = make(0.1, [(0.05, 0.05, 0.1), (0.15, 0.05, -0.2), (9.05, 0.05, 1.4), (-30.05, 0.05, 7.0)])
    found = of("mean_height", before, now)
    assert (found.cells, found.only_before, found.only_now) == (3, 2, 1)
    # Cells hold float64 sums, so heights come back within a few ulp of what was put in.
    assert found.median_before == pytest.approx(0.0, abs=1e-12)
    assert found.median_now == pytest.approx(0.1, abs=1e-12)
    assert found.median_change == pytest.approx(0.1, abs=1e-12)
    # Between the sorted 0.1, 0.2 and 0.4 the 95th percentile lies nine tenths of the way from 0.2 to 0.4.
    assert found.p95_abs_change == pytest.approx(0.38, abs=1e-12)
    # Where nothing is known a count is 0, which is no knowledge either.
    counts = of("count", before, now)
    assert (counts.cells, counts.only_before, counts.only_now) == (3, 2, 1)


@pytest.mark.parametrize("flipped", [False, True])
def test_tiles_that_only_one_map_has(flipped: bool) -> None:
    """Whichever is the finer, and whichever comes first: what only one knows is counted as that.

    The fine map's cells are a third as wide: its cell in the middle of a coarse cell is the one that is compared.
    """
    coarse = make(0.3, [(0.15, 0.15, 1.0), (-100.05, 40.05, 2.0)])
    fine = make(0.1, [(0.15, 0.15, 1.5), (70.05, -20.25, 3.0), (200.25, 200.25, 3.0)])
    before, now = (fine, coarse) if flipped else (coarse, fine)
    found = of("mean_height", before, now)
    only_coarse, only_fine = (found.only_now, found.only_before) if flipped else (found.only_before, found.only_now)
    assert (found.cells, only_coarse, only_fine) == (1, 1, 2)
    assert found.median_change == pytest.approx(-0.5 if flipped else 0.5, abs=1e-12)


def test_every_fine_tile_is_looked_at_however_the_grids_lie() -> None:
    """Cell sizes of no common measure: a fine tile lies over the border of two coarse ones, or of four."""
    coarse = make(0.13, [])
    centres = [(k + 0.5) * 0.13 for k in range(-400, 400, 7)]
    fine = make(0.1, [(x, y, 1.0) for x in centres for y in centres[::10]])
    found = of("count", coarse, fine)
    assert (found.cells, found.only_before, found.only_now) == (0, 0, len(centres) * len(centres[::10]))


@pytest.mark.parametrize(("i", "j"), [(63, 63), (64, 63), (63, 64), (64, 64)])
def test_a_fine_tile_over_a_corner_of_coarse_ones(i: int, j: int) -> None:
    """One point in the fine tile (1, 1), in each of the four coarse tiles that it lies over."""
    at = ((i + 0.5) * 0.13, (j + 0.5) * 0.13, 1.0)
    found = of("count", make(0.13, []), make(0.1, [at]))
    assert (found.cells, found.only_before, found.only_now) == (0, 0, 1)


def test_empty_maps() -> None:
    found = of("mean_height", make(0.1, []), make(0.2, []))
    assert (found.cells, found.only_before, found.only_now) == (0, 0, 0)
    assert math.isnan(found.median_change)
    assert math.isnan(found.p95_abs_change)


def test_cells_four_hundred_times_as_wide() -> None:
    """Only tiles that are there are looked at: the box of one coarse tile holds 655 million fine cells."""
    found = of("mean_height", make(0.05, [(10.01, 10.01, 1.0), (30.01, -9.99, 2.0)]), make(20.0, [(5.0, 5.0, 4.0)]))
    assert (found.cells, found.only_before, found.only_now) == (1, 1, 0)
    assert found.median_change == pytest.approx(3.0, abs=1e-12)
