"""Per-point times: the position is linear, the rotation follows the shorter arc, the covariance is linear."""

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation
from strategies import SECOND_NS, START_NS, limits, noises, seeds, trajectories

from roughmap import Limits, Noise, PointReason, RoughMap, Scan, Trajectory, georeference

NS = np.array([0, SECOND_NS // 4, SECOND_NS // 2, SECOND_NS])


def yaw(angle: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, sin(angle / 2), cos(angle / 2)


def two_poses(first: object, second: object, covariance: np.ndarray | None = None) -> Trajectory:
    """From the origin to (8, -4, 2) within a second."""
    S = np.zeros((2, 6, 6)) if covariance is None else covariance
    return Trajectory([START_NS, START_NS + SECOND_NS], [(0, 0, 0), (8, -4, 2)], [first, second], S)


def ahead(offsets: np.ndarray = NS) -> Scan:
    """One return per time, 1 m ahead."""
    return Scan(np.tile((1.0, 0.0, 0.0), (len(offsets), 1)), START_NS, offsets)


def test_the_position_is_linear() -> None:
    """At 0, 1/4, 1/2, 1 of (8, -4, 2), 1 m ahead along x."""
    points, _, reason, *_ = georeference(ahead(), two_poses(yaw(0), yaw(0)), Noise(0.01))
    assert not reason.any()
    np.testing.assert_array_equal(points, [(1, 0, 0), (3, -1, 0.5), (5, -2, 1), (9, -4, 2)])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("angle", [0.0, 1e-12, 0.02, pi / 2, 3.1, -2.0])
def test_the_rotation_goes_evenly_along_the_shorter_arc(angle: float, sign: float) -> None:
    """q and -q are the same rotation: with either, the robot turns by at most half a turn."""
    way = two_poses(yaw(0.3), sign * np.array(yaw(0.3 + angle)))
    points, *_ = georeference(ahead(), way, Noise(0.01))
    u = NS / SECOND_NS
    heading = 0.3 + u * angle
    expected = u[:, None] * (8, -4, 2) + np.stack([np.cos(heading), np.sin(heading), np.zeros(4)], axis=1)
    # Near half a turn the weights are quotients of small numbers: 1 / sinc(pi / 2) is only 1.6.
    np.testing.assert_allclose(points, expected, rtol=0, atol=5e-15)


@examples(50)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-9, 1e-3, 0.3, 3.0]))
def test_slerp_turns_at_a_constant_rate(seed: int, scale: float) -> None:
    """Between two poses the axis of rotation is constant and the angle is proportional to the time."""
    rng = np.random.default_rng(seed)
    first = Rotation.random(random_state=rng)
    axis = rng.normal(size=3)
    step = scale * axis / np.linalg.norm(axis)
    second = Rotation.from_rotvec(step) * first
    way = two_poses(first.as_quat(), second.as_quat())
    points, *_ = georeference(ahead(), way, Noise(0.01))
    u = NS / SECOND_NS
    expected = u[:, None] * (8, -4, 2) + (Rotation.from_rotvec(u[:, None] * step) * first).apply((1, 0, 0))
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-14)


def test_the_covariance_is_linear() -> None:
    """Without a lever and with pose noise only, S is the pose's upper left block: from 1e-4 to 9e-4 in quarters."""
    pair = np.stack([np.diag([1e-4] * 3 + [0.0] * 3), np.diag([9e-4] * 3 + [0.0] * 3)])
    _, covariance, *_ = georeference(ahead(), two_poses(yaw(0), yaw(1), pair), Noise(0.0))
    np.testing.assert_allclose(covariance[:, 0, 0], [1e-4, 3e-4, 5e-4, 9e-4], rtol=1e-14)
    np.testing.assert_allclose(covariance[:, 0, 1], 0.0, atol=1e-19)


def test_a_scan_without_times_is_placed_at_its_stamp() -> None:
    way = two_poses(yaw(0), yaw(1))
    still = georeference(Scan([(1, 0, 0)], START_NS + SECOND_NS // 4), way, Noise(0.01))
    moved = georeference(Scan([(1, 0, 0)], START_NS, np.array([SECOND_NS // 4])), way, Noise(0.01))
    for a, b in zip(still, moved, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_bracket_is_found_in_any_order_of_the_points() -> None:
    """Each search starts at the previous bracket: points in order, reversed and shuffled are placed the same."""
    rng = np.random.default_rng(5)
    stamps = START_NS + np.cumsum(rng.integers(1, 10**7, 90))
    way = Trajectory(stamps, rng.normal(size=(90, 3)), rng.normal(size=(90, 4)), np.zeros((90, 6, 6)))
    offsets = np.concatenate([np.sort(rng.integers(0, stamps[-1] - START_NS, 400)), stamps - START_NS])
    points = rng.normal(0, 3, (490, 3))
    first = georeference(Scan(points, START_NS, offsets), way, Noise(0.01))
    order = rng.permutation(490)
    second = georeference(Scan(points[order], START_NS, offsets[order]), way, Noise(0.01))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a[order], b)


def test_no_extrapolation_and_no_wide_gaps() -> None:
    """Poses at 0.0, 0.1 and 0.7 s: times before, after and in the gap have no pose; exact stamps have one."""
    stamps = START_NS + np.array([0, 1, 7]) * (SECOND_NS // 10)
    way = Trajectory(stamps, np.zeros((3, 3)), np.tile((0, 0, 0, 1), (3, 1)), np.zeros((3, 6, 6)))
    offsets = np.array([0, 1, SECOND_NS // 10, SECOND_NS // 10 + 1, 7 * SECOND_NS // 10, 7 * SECOND_NS // 10 + 1])
    _, _, reason, *_ = georeference(ahead(offsets), way, Noise(0.01), Limits(max_pose_gap=0.5))
    missing = int(PointReason.NO_POSE)
    assert reason.tolist() == [0, 0, 0, missing, 0, missing]
    _, _, reason, *_ = georeference(ahead(offsets), way, Noise(0.01), Limits(max_pose_gap=0.6))
    assert reason.tolist() == [0, 0, 0, 0, 0, missing]
    early = Scan([(1, 0, 0)], START_NS - 1)
    assert georeference(early, way, Noise(0.01))[2].tolist() == [missing]


@pytest.mark.parametrize("ms", [500, 1001, 2010, 8030])
def test_poses_exactly_the_gap_apart(ms: int) -> None:
    """1.001, 2.01 and 8.03, times 1e9 in float64, fall short of a whole number of nanoseconds."""
    stamps = START_NS + np.array([0, ms * 1_000_000])
    way = Trajectory(stamps, np.zeros((2, 3)), np.tile((0, 0, 0, 1), (2, 1)), np.zeros((2, 6, 6)))
    between, limits = ahead(np.array([ms])), Limits(max_pose_gap=ms / 1000)
    assert georeference(between, way, Noise(0.01), limits)[2].tolist() == [0]
    way = Trajectory(stamps + np.array([0, 1]), np.zeros((2, 3)), way.rotation, way.covariance)
    assert georeference(between, way, Noise(0.01), limits)[2].tolist() == [int(PointReason.NO_POSE)]


def test_deskewing_makes_a_turning_wall_flat() -> None:
    """A wall 5 m ahead, scanned while the robot turns by 1 rad: all points fall into one column of cells."""
    way = two_poses(yaw(0), yaw(1.0))
    u = np.linspace(0, 1, 500)
    position = u[:, None] * (8, -4, 2)
    wall = np.stack([np.full(500, 20.05), np.linspace(-3, 3, 500), np.zeros(500)], axis=1)
    seen = Rotation.from_euler("z", u[:, None]).inv().apply(wall - position)
    offsets = np.round(u * SECOND_NS).astype(np.int64)
    m = RoughMap(error_model="point", threads=1)
    m.add_scan(Scan(seen, START_NS, offsets), way, Noise(0.01))
    extent = m.region((19, -4, 21, 4), ["count"])["count"]
    assert np.flatnonzero(extent.any(axis=0)).tolist() == [10]
    assert extent.sum() == 500


@examples(80)
@given(
    path=trajectories(),
    noise=noises,
    rules=limits,
    seed=seeds,
    span=st.sampled_from([SECOND_NS // 3, SECOND_NS]),
    outside=st.booleans(),
)
def test_the_order_of_points_does_not_matter_to_a_point(
    path: Trajectory, noise: Noise, rules: Limits, seed: int, span: int, outside: bool
) -> None:
    """In no order, in the order of their times, or a few at a time: each point gets the same bytes."""
    rng = np.random.default_rng(seed)
    number = 700
    returns, offsets = rng.normal(0, 3.0, (number, 3)), rng.integers(0, span, number)
    offsets[::9] = rng.choice(path.stamp_ns, len(offsets[::9])) - START_NS  # some of these are before the scan
    if not outside:
        offsets = np.clip(offsets, 0, SECOND_NS)
    returns[rng.random(number) < 0.02] = 0.0
    rules = Limits(rules.min_range, rules.max_range, rules.ceiling, rules.ceiling_slope, np.inf, rules.exclude)

    def placed(chosen: np.ndarray) -> tuple[np.ndarray, ...]:
        scan = Scan(returns[chosen], START_NS, offsets[chosen], (0.2, 0.0, 1.0), (0.1, 0.0, 0.0, 1.0))
        return georeference(scan, path, noise, rules)

    mixed = placed(np.arange(number))
    order = np.argsort(offsets, kind="stable")
    few = [placed(part) for part in np.array_split(np.arange(number), number // 20)]
    for n, column in enumerate(mixed):
        assert column[order].tobytes() == placed(order)[n].tobytes()
        assert column.tobytes() == np.concatenate([part[n] for part in few]).tobytes()


@examples(40)
@given(path=trajectories(), seed=seeds)
def test_a_mounting_without_uncertainty_adds_nothing(path: Trajectory, seed: int) -> None:
    """Leaving out its terms equals adding those of a mounting whose uncertainty vanishes beside the rest."""
    returns = np.random.default_rng(seed).normal(0, 3.0, (300, 3))
    offsets = np.linspace(0, SECOND_NS // 4, 300).astype(np.int64)
    for times in (None, offsets):
        scan = Scan(returns, START_NS, times, (0.2, 0.0, 1.0))
        without, vanishing = (
            georeference(scan, path, Noise(0.01, 0.0, 0.001, (sigma,) * 6)) for sigma in (0.0, 1e-150)
        )
        assert not np.nan_to_num(without.mount).any()
        assert np.nan_to_num(vanishing.mount).max() < 1e-200
        for one, other in zip(without._replace(mount=0), vanishing._replace(mount=0), strict=True):
            np.testing.assert_array_equal(one, other)
