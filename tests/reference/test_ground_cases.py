"""The ground's oracle against cases worked out by hand: cells of 0.1 m, a band of 0.15 m, and three points to be sure.

With the ground at 0 the base is floor(10 * 0) - 11 = -11: nibble k holds heights from 0.05 (k - 22) m.
"""

from typing import Any

import numpy as np
import pytest

from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, SUPPORTED, TRUST_DTYPE, PointReason
from roughmap.map import RoughMap
from roughmap.reference.ground import GroundOracle
from roughmap.reference.ground_cell import GroundCell
from roughmap.reference.ground_clearing import clear_cells, range_image

SECOND = 1_000_000_000


def oracle(model: str = "point", **options: Any) -> GroundOracle:
    return GroundOracle(RoughMap(error_model=model, threads=1, **options).settings)


def cell_of(*heights: float, at: GroundOracle | None = None, second: int = 0, **options: Any) -> GroundCell:
    """Return the one cell after points of these heights."""
    o = at or oracle()
    o.add(np.array([(0.05, 0.05, h) for h in heights]).reshape(-1, 3), None, second * SECOND, **options)
    return o.cells[0, 0]


def hits(cell: GroundCell) -> dict[int, int]:
    return {k: n for k, n in enumerate(cell.bins) if n}


def test_points_within_the_band_make_the_ground_and_no_column() -> None:
    cell = cell_of(1.0, 1.1, 1.05, 1.2, 0.95)
    assert (cell.count, cell.low, cell.high, cell.weight, cell.weight_sq) == (5, 0.95, 1.2, 5.0, 5.0)
    assert cell.mean == pytest.approx(1.06)
    assert cell.m2 == pytest.approx(np.var([1.0, 1.1, 1.05, 1.2, 0.95]) * 5)
    assert (cell.flags, cell.candidates, hits(cell)) == (0, 0, {})


def test_a_wide_cell_has_a_wide_band() -> None:
    assert cell_of(0.0, 0.29, at=oracle(cell_size=0.5)).count == 2  # 0.6 * 0.5 m
    cell = cell_of(0.0, 0.31, at=oracle(cell_size=0.5))
    assert (cell.count, hits(cell)) == (1, {28: 1})


def test_what_hangs_over_a_sure_ground_is_counted_there() -> None:
    cell = cell_of(0.0, 0.0, 0.0, 2.62, 2.62, 2.89, 2.91, 50.0)
    assert (cell.count, cell.mean, cell.base, cell.flags, cell.candidates) == (3, 0.0, -11, BASED, 0)
    assert hits(cell) == {74: 2, 79: 1}


def test_a_nibble_stops_at_15() -> None:
    assert hits(cell_of(0.0, 0.0, 0.0, *[1.01] * 40)) == {42: 15}


def test_a_person_leaves_hits_and_no_ground() -> None:
    cell = cell_of(*[0.0] * 5, *np.repeat([0.27, 0.92, 1.71], 6))
    assert (cell.count, cell.mean) == (5, 0.0)
    assert hits(cell) == {22 + 5: 6, 22 + 18: 6, 22 + 34: 6}


def test_a_low_stray_gives_way_to_the_ground_above() -> None:
    """Base -16 for the stray at -0.5: 0.01 m is nibble 32. At the third hit the bins move by 5 bytes, ten nibbles."""
    cell = cell_of(-0.5, 0.01, 0.01)
    assert (cell.count, cell.mean, cell.base, hits(cell)) == (1, -0.5, -16, {32: 2})
    cell = cell_of(-0.5, 0.01, 0.01, 0.01)
    assert (cell.count, cell.mean, cell.m2, cell.low, cell.high) == (1, 0.01, 0.0, 0.01, 0.01)
    assert (cell.base, cell.flags) == (-11, SUPPORTED | BASED)
    assert hits(cell) == {22: 3, 12: 1}  # the stray is one hit, at -0.5


def test_hits_in_the_bins_beside_it_count() -> None:
    cell = cell_of(-0.5, 0.04, 0.06, 0.01)
    assert (cell.mean, hits(cell)) == (0.01, {22: 2, 23: 1, 12: 1})


def test_a_stray_far_below_gives_way_by_a_candidate() -> None:
    """The bins of a stray at -5 end at -2.1. Far apart points vote each other down."""
    cell = cell_of(-5.0, 0.0, 0.1)
    assert (cell.candidates, cell.candidate_mean, hits(cell)) == (2, 0.05, {})
    cell = cell_of(-5.0, 0.0, 0.1, 3.0)
    assert (cell.candidates, cell.candidate_mean) == (1, 0.05)
    cell = cell_of(-5.0, 0.0, 3.0)
    assert (cell.candidates, cell.candidate_mean) == (1, 3.0)
    cell = cell_of(-5.0, 0.0, 0.1, 0.0)
    assert (cell.count, cell.mean, cell.base, cell.flags, cell.candidates) == (1, 0.0, -11, SUPPORTED | BASED, 0)
    assert hits(cell) == {}  # the stray is below the bins


def test_a_roof_seen_first_gives_way_to_the_ground_under_it() -> None:
    """Two points at 2.5 m (base 14): 0 m is nibble -28, below the bins."""
    cell = cell_of(2.5, 2.5, 0.0, 0.0)
    assert (cell.count, cell.base, cell.candidates) == (2, 14, 2)
    cell = cell_of(2.5, 2.5, 0.0, 0.0, 0.0)
    assert (cell.count, cell.mean, hits(cell)) == (1, 0.0, {72: 2})


def test_hits_over_a_new_ground_are_many_as_its_old_points_and_at_most_15() -> None:
    cell = cell_of(*[0.5] * 70, *[-0.3] * 11)  # need 12 for 70 points
    assert (cell.count, cell.mean) == (70, 0.5)
    cell = cell_of(*[0.5] * 70, *[-0.3] * 12)
    assert (cell.count, cell.mean, cell.base) == (1, -0.3, -14)
    assert hits(cell) == {22: 12, 38: 15}  # floor(20 * 0.5) + 28


@pytest.mark.parametrize(("count", "need"), [(3, 3), (19, 3), (20, 4), (44, 8), (59, 11), (60, 12), (1000, 12)])
def test_a_pit_needs_a_fifth_of_the_points(count: int, need: int) -> None:
    assert cell_of(*[0.0] * count, *[-0.72] * (need - 1)).count == count
    assert cell_of(*[0.0] * count, *[-0.72] * need).mean == -0.72


def test_a_deep_pit_needs_three_points() -> None:
    cell = cell_of(*[0.0] * 100, *[-4.0] * 2)
    assert (cell.count, cell.candidates) == (100, 2)
    cell = cell_of(*[0.0] * 100, *[-4.0] * 3)
    assert (cell.count, cell.mean, hits(cell)) == (1, -4.0, {})  # the old ground is above the bins, which end at -1.1
    # The bins reach 1.1 m down, so no hit in them is more than 2 m below the ground.


def test_points_between_a_ground_of_two_and_its_band_rise() -> None:
    """Unsure ground, two points: three hits above it are the ground; two points were there before: at most 2 hits."""
    cell = cell_of(0.0, 0.0, 0.5, 0.5, 0.5)
    assert (cell.count, cell.mean, cell.base, hits(cell)) == (1, 0.5, -6, {22: 3, 12: 2})


def test_a_new_ground_is_sure_of_itself() -> None:
    cell = cell_of(-0.5, 0.01, 0.01, 0.01, *[0.51] * 9)
    assert (cell.count, cell.mean) == (1, 0.01)
    assert hits(cell)[32] == 9


def test_single_hits_are_dropped_after_30_seconds() -> None:
    o = oracle()
    cell = cell_of(0.0, 0.0, 0.0, 0.5, 1.0, 1.0, at=o, second=100)
    assert hits(cell_of(2.0, at=o, second=130)) == {32: 1, 42: 2, 62: 1}
    assert cell.above_updated == 130
    assert hits(cell_of(2.0, at=o, second=50)) == {32: 1, 42: 2, 62: 2}
    assert cell.above_updated == 130
    assert hits(cell_of(2.5, at=o, second=161)) == {42: 2, 62: 2, 72: 1}
    assert hits(cell_of(0.0, at=o, second=500)) == {42: 2, 62: 2, 72: 1}  # the ground's points leave the column alone
    assert cell.above_updated == 161


def test_a_candidate_is_dropped_after_30_seconds() -> None:
    o = oracle()
    cell_of(-5.0, 0.0, 0.0, at=o, second=100)
    cell = cell_of(0.0, at=o, second=131)
    assert (cell.mean, cell.candidates) == (-5.0, 1)


def test_the_age_is_judged_before_the_hit() -> None:
    """Above the bins of a sure ground nothing is counted, but time goes on."""
    o = oracle()
    cell = cell_of(0.0, 0.0, 0.0, 0.5, at=o, second=100)
    cell_of(10.0, at=o, second=131)
    assert (hits(cell), cell.above_updated) == ({}, 131)


def test_an_up_point_is_never_ground() -> None:
    o = oracle()
    assert o.add(np.array([(0.05, 0.05, 2.5)]), up=True) == 1
    assert o.cells == {}
    cell = cell_of(0.0, at=o)
    cell_of(*[0.02] * 5, at=o, up=True)
    assert (cell.count, cell.mean, hits(cell)) == (1, 0.0, {22: 5})
    cell_of(*[2.5] * 5, *[30.0] * 5, *[-0.5] * 5, *[-9.0] * 5, at=o, up=True)
    assert (cell.count, cell.mean, cell.candidates, hits(cell)) == (1, 0.0, 0, {22: 5, 72: 5, 12: 5})


def test_up_points_count_as_hits_for_a_later_ground() -> None:
    o = oracle()
    cell_of(-0.5, at=o)
    cell_of(0.01, 0.01, at=o, up=True)
    assert cell_of(0.01, at=o).mean == 0.01


def test_bins_move_up_and_down_by_whole_bytes() -> None:
    """From base -11 to floor(-7.2) - 11 = -19: eight bytes, sixteen nibbles up; what was above 2.1 m falls out."""
    cell = cell_of(*[0.0] * 3, 0.51, 1.01, 2.51, *[-0.72] * 3)
    assert (cell.mean, cell.base) == (-0.72, -19)
    # the old ground at 0: 3 hits at nibble 38; the pit's own: floor(-14.4) + 38 = 23
    assert hits(cell) == {23: 3, 38: 3, 48: 1, 58: 1}
    # Up again: an unsure ground of one point, bins from base -16 to -11; what was below -1.1 falls out.
    o = oracle()
    cell_of(-0.5, at=o)
    cell_of(-1.3, -1.0, at=o, up=True)
    assert hits(cell_of(at=o)) == {6: 1, 12: 1}
    assert hits(cell_of(0.01, 0.01, 0.01, at=o)) == {2: 1, 12: 1, 22: 3}


def test_the_second_of_the_ground_is_the_newest() -> None:
    o = oracle()
    cell_of(0.0, at=o, second=7)
    assert cell_of(0.0, at=o, second=3).updated == 7
    assert cell_of(-9.0, -9.0, -9.0, at=o, second=5).updated == 5  # of another ground


def test_a_weighted_point_is_off_the_ground_only_where_its_share_is_largest() -> None:
    """A body of 0.04 m around x = 0.095 has 5/8 of itself in the first cell, 3/8 in the second."""
    o = oracle("cuboid")
    S = np.diag([1.0, 1.0, 1.0]) * 1e-4
    o.add(np.array([(0.095, 0.05, 0.0)]), S)
    first, second = o.cells[0, 0], o.cells[1, 0]
    assert (first.count, second.count) == (1, 1)
    assert (first.weight / second.weight, first.mean) == (pytest.approx(5 / 3), 0.0)
    o.add(np.array([(0.095, 0.05, 1.01)]), S)
    assert (hits(first), hits(second), second.flags) == ({42: 1}, {}, 0)
    o.add(np.array([(0.1, 0.05, 2.01)]), S)  # halves: the first of the two
    assert (hits(first), hits(second)) == ({42: 1, 62: 1}, {})


def test_the_bounds_hide_the_largest_share() -> None:
    """Bounds end at x = 0.1, but for half a cell the map is written: the body's main cell is outside."""
    o = oracle("cuboid", bounds=(0.0, 0.0, 0.1, 1.0))
    S = np.diag([1.0, 1.0, 1.0]) * 1e-4
    o.add(np.array([(0.05, 0.05, 0.0), (0.095, 0.05, 0.0), (0.105, 0.05, 1.0)]), S)
    assert set(o.cells) == {(0, 0)}
    assert (o.cells[0, 0].count, hits(o.cells[0, 0])) == (2, {})


def test_points_of_no_height_or_too_uncertain_are_refused() -> None:
    o = oracle("cuboid")
    points = np.array([(0.05, 0.05, 1e7), (0.05, 0.05, 1.1e7), (0.05, 0.05, np.nan), (np.inf, 0.05, 0.0)])
    assert o.add(points, np.diag([1e-4, 1e-4, 1e-4])) == 1
    assert o.add(points, np.diag([0.26, 0.0, 0.0])) == 0
    assert o.add(points, np.diag([0.0, 0.0, 0.26])) == 0


def test_the_trust_of_one_pose_is_its_variance() -> None:
    """Points of one scan share one error: their number does not help."""
    cell = cell_of(*[0.0] * 50, common=4e-4, mount=1e-4)
    assert cell.variance == pytest.approx(4e-4, rel=1e-5)
    assert cell.shared == pytest.approx(4e-4, rel=1e-5)
    assert (cell.pose_variance, cell.mount_sigma) == (pytest.approx(4e-4, rel=1e-6), pytest.approx(1e-2, rel=1e-6))


def test_the_trust_of_scans_far_apart_in_time_adds_up() -> None:
    o = oracle()
    for scan in range(10):
        cell = cell_of(0.0, at=o, second=100 * scan, common=4e-4, mount=1e-4)
    assert cell.variance == pytest.approx(4e-5, rel=1e-5)
    assert cell.mount_sigma == pytest.approx(1e-2, rel=1e-6)  # the mounting's error stays


def test_the_trust_of_two_scans_by_hand() -> None:
    """10 s apart with tau = 5 s: y = 1/2, so that a sixteenth of the covariance is left."""
    o = oracle()
    cell_of(0.0, at=o, second=0, common=1.0)
    cell = cell_of(0.0, at=o, second=10, common=0.5)
    assert (cell.variance, cell.shared, cell.pose_variance) == (0.25 * (1.0 + 2 / 16 + 0.5), 0.5 / 16 + 0.25, 0.75)
    cell = cell_of(0.0, at=o, second=5, common=-1.0)  # earlier by 5 s; a negative variance is none
    assert cell.stamp_ms == 5000
    assert cell.shared == pytest.approx(0.75**4 * (0.5 / 16 + 0.25) * 2 / 3, rel=1e-6)


def test_stamps_wrap_at_2_32_milliseconds() -> None:
    o = oracle()
    o.add(np.zeros((1, 3)), None, (2**32 - 1) * 1_000_000, common=1.0)
    o.add(np.zeros((1, 3)), None, (2**32 + 1) * 1_000_000, common=1.0)
    assert o.cells[0, 0].stamp_ms == 1
    assert o.cells[0, 0].variance == pytest.approx(1.0, abs=1e-3)


def test_records_are_those_of_tiles() -> None:
    cell, trust, column = cell_of(0.0, 0.0, 0.0, 0.04, 0.21, 0.21, 2.0, common=1e-4).records()
    assert (cell.dtype, trust.dtype, column.dtype) == (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE)
    assert (len(cell.tobytes()), len(trust.tobytes()), len(column.tobytes())) == (64, 20, 64)
    assert column["bins"][0].nonzero()[0].tolist() == [13, 31]
    assert (column["bins"][0][13], column["bins"][0][31]) == (0x02, 0x01)  # nibbles 26 and 62: both low halves
    assert (column["flags"], column["base"], cell["count"]) == (BASED, -11, 4)


def cleared(returns: list[tuple[float, float, float]], reason: int = 0) -> tuple[int, dict[int, int]]:
    """Return the cells halved by these returns, and the hits left in a cell 2 m ahead of the sensor."""
    o = oracle()
    place = np.array([(2.05, 0.05, h) for h in (0.0, 0.0, 0.0, *[1.01] * 5)])
    o.add(place)
    x, y, z = (np.array([r[axis] for r in returns]) for axis in range(3))
    origin = (0.05, 0.05, 1.0)
    halved = clear_cells(o.cells, range_image(x, y, z, np.full(len(x), reason, np.uint8), origin), origin, 0.1)
    return halved, hits(o.cells[20, 0])


def test_hits_that_beams_passed_are_halved() -> None:
    """Nibble 42 has its centre at 1.025 m: 0.72 degrees above the sensor, 2 m away."""
    behind = [(5.05, 0.05, 1.0), (5.05, 0.05, 1.08)]
    assert cleared(behind) == (1, {42: 2})
    assert cleared(behind, int(PointReason.RANGE)) == (1, {42: 2})
    assert cleared(behind, int(PointReason.NO_POSE)) == (0, {42: 5})
    assert cleared(behind[:1]) == (0, {42: 5})  # two pixels must be seen
    assert cleared([*behind, (2.3, 0.05, 1.0)]) == (0, {42: 5})  # a return too near behind it
    assert cleared([*behind, (2.4, 0.05, 1.0)]) == (1, {42: 2})
    assert cleared([*behind, (0.1, 0.05, 1.0)]) == (1, {42: 2})  # nearer than 0.1 m: the robot itself
    assert cleared([(5.05, 0.05, 2.0), (5.05, 0.05, 2.1)]) == (0, {42: 5})  # other directions
