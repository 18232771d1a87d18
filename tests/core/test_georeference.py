"""Eq. 1 against a plain calculation with numpy matrices and scipy's rotations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation, Slerp
from strategies import START_NS, limits, noises, scans, trajectories, turned

from roughmap import Limits, Noise, PointReason, Scan, Trajectory, georeference


def cross(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def pose_then(way: Trajectory, t: int, gap_s: float) -> tuple[np.ndarray, Rotation, np.ndarray] | None:
    """Position, rotation and covariance at ``t``; None without poses around it."""
    exact = np.flatnonzero(way.stamp_ns == t)
    if len(exact):
        n = exact[0]
        return way.position[n], Rotation.from_quat(way.rotation[n]), way.covariance[n]
    n = int(np.searchsorted(way.stamp_ns, t)) - 1
    if n < 0 or n + 1 >= len(way.stamp_ns) or way.stamp_ns[n + 1] - way.stamp_ns[n] > gap_s * 1e9:
        return None
    u = (t - way.stamp_ns[n]) / (way.stamp_ns[n + 1] - way.stamp_ns[n])
    between = Slerp([0, 1], Rotation.from_quat(way.rotation[n : n + 2]))(u)
    return (
        (1 - u) * way.position[n] + u * way.position[n + 1],
        between,
        (1 - u) * way.covariance[n] + u * way.covariance[n + 1],
    )


def place(scan: Scan, way: Trajectory, noise: Noise, n: int, gap_s: float) -> tuple[np.ndarray, ...]:
    """Return one point, the three parts of its covariance, and its lever from the sensor, in the design's notation."""
    t = scan.stamp_ns + (0 if scan.offsets_ns is None else int(scan.offsets_ns[n]))
    found = pose_then(way, t, gap_s)
    assert found is not None
    position, turn, S_pose = found
    p = scan.points[n].astype(np.float64)
    mounted = Rotation.from_quat(scan.rotation)
    lever = turn.apply(mounted.apply(p) + scan.translation)
    lever_m = turn.apply(mounted.apply(p))
    r = np.linalg.norm(p)
    u = p / r
    sr = noise.range_sigma + noise.range_sigma_per_m * r + noise.range_sigma_per_m2 * r**2
    across = noise.beam_sigma * r
    S_sensor = sr**2 * np.outer(u, u) + across**2 * (np.eye(3) - np.outer(u, u))
    R_ms = (turn * mounted).as_matrix()
    J = np.hstack([np.eye(3), -cross(lever)])
    J_m = np.hstack([np.eye(3), -cross(lever_m)])
    axes = np.kron(np.eye(2), turn.as_matrix())
    S_mount = axes @ np.diag(np.square(noise.mount_sigma)) @ axes.T
    return position + lever, R_ms @ S_sensor @ R_ms.T, J @ S_pose @ J.T, J_m @ S_mount @ J_m.T, lever_m


@examples(150)
@given(scan=scans(most=12), way=trajectories(), noise=noises, rules=limits)
def test_any_scan(scan: Scan, way: Trajectory, noise: Noise, rules: Limits) -> None:
    points, covariance, reason, common, mount, up = georeference(scan, way, noise, rules)
    for n in range(len(points)):
        if reason[n] != 0:
            assert np.isnan(points[n]).all()
            assert np.isnan(covariance[n]).all()
            assert np.isnan([common[n], mount[n]]).all()
            assert not up[n]
            continue
        where, S_beam, S_pose, S_mount, lever = place(scan, way, noise, n, rules.max_pose_gap)
        S = S_beam + S_pose + S_mount
        # float64 near 5e6 has steps of 1e-9; levers of up to 30 m add about 1e-14. scipy's slerp uses the library's
        # sine and differs by about 1e-15, near half a turn by 1e-15 / sinc.
        np.testing.assert_allclose(points[n], where, rtol=0, atol=4e-9 if abs(where).max() > 1e4 else 1e-11)
        # Levers are computed before the position is added: as exact in UTM as at the origin.
        np.testing.assert_allclose(covariance[n], S, rtol=0, atol=1e-11 * np.trace(S))
        np.testing.assert_array_equal(covariance[n], covariance[n].T)
        np.testing.assert_allclose(common[n], S_pose[2, 2], rtol=0, atol=1e-11 * np.trace(S_pose))
        np.testing.assert_allclose(mount[n], S_mount[2, 2], rtol=0, atol=1e-11 * np.trace(S_mount))
        rise = lever[2] / np.hypot(lever[0], lever[1])
        assert up[n] == (rise > 0.546) or abs(rise - 0.546) < 1e-9


def test_the_lever_is_measured_from_the_base() -> None:
    """The same scan at the origin and in UTM has the same covariances to the bit."""
    pose = np.diag([1e-4] * 3 + [1e-4] * 3)[None]
    rng = np.random.default_rng(1)
    scan = Scan(rng.normal(0, 5, (300, 3)), 0, translation=(0.3, 0, 1), rotation=(0.1, 0.2, 0.3, 0.9))
    made = [
        georeference(scan, Trajectory([0], [where], [(0.1, -0.2, 0.5, 0.8)], pose), Noise(0.02))
        for where in ((0, 0, 0), (512345.67, 5403210.98, 431.0))
    ]
    np.testing.assert_array_equal(made[0][1], made[1][1])
    np.testing.assert_array_equal(made[0][0] + np.array((512345.67, 5403210.98, 431.0)), made[1][0])


def test_float32_points_equal_their_float64_values() -> None:
    rng = np.random.default_rng(2)
    small = rng.normal(0, 5, (100, 3)).astype(np.float32)
    way = Trajectory([0], [(1, 2, 3)], [(0.1, -0.2, 0.5, 0.8)], np.eye(6)[None] * 1e-4)
    first, second = (georeference(Scan(p, 0), way, Noise(0.02, beam_sigma=1e-3)) for p in (small, small.astype(float)))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("scale", [2e-6, 0.5, -1.0, 1e160, -1e308])
def test_quaternions_are_normalised(scale: float) -> None:
    turn = np.array([0.5, -0.5, 0.5, 0.5])
    scan = Scan([(1.0, 2.0, 3.0)], 0, rotation=turn * scale)
    way = Trajectory([0], [(0, 0, 0)], [turn * scale], np.zeros((1, 6, 6)))
    # (x, y, z) -> (-y, -z, x)? A third of a turn: the expected values are scipy's for the unit quaternion.
    expected = Rotation.from_quat(turn).apply(Rotation.from_quat(turn).apply((1.0, 2.0, 3.0)))
    points, *_ = georeference(scan, way, Noise(0.01))
    np.testing.assert_allclose(points[0], expected, rtol=1e-15)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 9e-7), (5e-7, 5e-7, 5e-7, 4e-7)])
def test_quaternions_too_short_to_turn(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"Scan\.rotation.*1e-06"):
        Scan([(1, 2, 3)], 0, rotation=quaternion)
    with pytest.raises(ValueError, match=r"Trajectory\.rotation.*1e-06"):
        Trajectory([0, 1], np.zeros((2, 3)), [(0, 0, 0, 1), quaternion], np.zeros((2, 6, 6)))


def test_only_the_upper_triangle_of_a_pose_covariance_is_read() -> None:
    rng = np.random.default_rng(3)
    factor = rng.normal(0, 0.01, (6, 6))
    whole = factor @ factor.T
    scan = Scan(rng.normal(0, 5, (20, 3)), 0)
    _, a, *_ = georeference(scan, Trajectory([0], [(0, 0, 0)], [(0, 0, 0, 1)], whole[None]), Noise(0.01))
    _, b, *_ = georeference(scan, Trajectory([0], [(0, 0, 0)], [(0, 0, 0, 1)], np.triu(whole)[None]), Noise(0.01))
    np.testing.assert_array_equal(a, b)


@examples(30)
@given(
    roll=st.floats(-3, 3),
    yaw=st.floats(-3, 3),
    tilt=st.floats(-1.5, 1.5),
    mount=st.sampled_from([None, (0.02, 0.0, 0.01, 0.004, 0.006, 0.01)]),
)
def test_monte_carlo(roll: float, yaw: float, tilt: float, mount: tuple[float, ...] | None) -> None:
    """Draw errors and place the point with each: the spread must agree with eq. 1.

    100,000 draws give a variance to sqrt(2 / 1e5) = 0.45 percent and a correlation to 0.32 percent, one sigma. With six
    numbers and 30 examples the tolerance is five sigmas: 2.3 percent of sqrt(Sii Sjj). Angles of at most 0.02 put
    second-order terms at 0.02^2.
    """
    rng = np.random.default_rng(4)
    number = 100_000
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    sigma = np.array([0.02, 0.03, 0.01, 0.01, 0.005, 0.02])
    mixed = axes @ np.diag(sigma) @ axes.T  # its square is the covariance, mixing positions and angles
    scale = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    S_pose = (scale[:, None] * mixed) @ (scale[:, None] * mixed).T
    turn, mounted = Rotation.from_euler("xz", [roll, yaw]), Rotation.from_euler("y", tilt)
    position, translation, p = np.array([100.0, -50.0, 7.0]), np.array([0.4, -0.1, 1.2]), np.array([6.0, 2.0, -1.5])
    noise = Noise(0.02, 0.001, 0.004, mount)
    way = Trajectory([START_NS], [position], [turn.as_quat()], S_pose[None])
    scan = Scan([p], START_NS, translation=translation, rotation=mounted.as_quat())
    points, covariance, *_ = georeference(scan, way, noise)

    r = np.linalg.norm(p)
    u = p / r
    draws = rng.normal(size=(number, 3)) * noise.beam_sigma * r
    draws += (rng.normal(size=number) * (0.02 + 0.001 * r) - draws @ u)[:, None] * u
    errors = rng.normal(size=(number, 6)) @ (scale[:, None] * mixed).T
    shaken = rng.normal(size=(number, 6)) * np.asarray(noise.mount_sigma)
    # Mounting errors are in the robot's axes: (Exp(dtheta) R_robot_sensor, t + dt).
    in_robot = (Rotation.from_rotvec(shaken[:, 3:]) * mounted).apply(p + draws) + translation + shaken[:, :3]
    seen = (Rotation.from_rotvec(errors[:, 3:]) * turn).apply(in_robot) + position + errors[:, :3]
    said, found = covariance[0], np.cov(seen.T)
    spread = np.sqrt(np.diag(said))
    assert np.abs((found - said) / np.outer(spread, spread)).max() < 0.023
    # The mean is off by 5 / sqrt(1e5) = 0.016 sigmas by chance, and by half the squared angle times the lever, 1 mm.
    np.testing.assert_allclose(seen.mean(axis=0), points[0], rtol=0, atol=0.016 * spread.max() + 1e-3)


def test_a_sphere_of_errors_stays_a_sphere() -> None:
    """range_sigma = beam_sigma r makes the scanner's error a sphere, which no rotation changes."""
    scan = Scan([(0.0, 3.0, 4.0)], 0, rotation=(0.3, 0.1, -0.7, 0.2))
    way = Trajectory([0], [(9, 9, 9)], [(0.1, -0.2, 0.5, 0.8)], np.zeros((1, 6, 6)))
    _, covariance, reason, *_ = georeference(scan, way, Noise(0.05, beam_sigma=0.01))
    assert reason[0] == PointReason.KEPT
    np.testing.assert_allclose(covariance[0], turned(np.eye(3), np.array([0.05] * 3)), rtol=1e-13, atol=1e-17)
