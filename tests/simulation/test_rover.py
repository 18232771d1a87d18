"""The simulated rover: its ground is exact, its messages repeat, its stated errors are its errors."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roughmap_schemas.cloud import decode_cloud
from roughmap_schemas.odometry import decode_odometry
from roughmap_schemas.point_times import contract_timed
from roughmap_service.simulation.ground import PERIOD, SPACING, Ground
from roughmap_service.simulation.publishing import merged
from roughmap_service.simulation.rover import MOUNT, POSE_SIGMA, Message, Rover, rovers
from roughmap_service.simulation.scanner import Scanner
from roughmap_service.simulation.world import World, bare, inhabited

START_NS = 1_700_000_000_000_000_000
SMALL = Scanner(rings=16, columns=64)


@pytest.fixture(scope="module")
def world() -> World:
    return inhabited(3)


@pytest.fixture(scope="module")
def ground(world: World) -> Ground:
    return world.ground


def rover(world: World, **settings: object) -> Rover:
    return Rover(world, scanner=SMALL, start_ns=START_NS, **settings)  # type: ignore[arg-type]


def cloud(message: Message) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, stamps and which came back."""
    decoded = contract_timed(decode_cloud(message.payload, max_message=1 << 24, max_points=1 << 20))
    assert decoded.offsets_ns is not None
    points = np.asarray(decoded.points, dtype=np.float64)
    return points, decoded.stamp_ns + decoded.offsets_ns, (points != 0).any(axis=1)


def test_the_ground_is_its_nodes_and_linear_between_them(ground: Ground) -> None:
    nodes = np.arange(5) * SPACING
    assert np.array_equal(ground.height(nodes, 0 * nodes), ground.grid[0, :5])
    middle = ground.height(nodes[1] + SPACING / 2, nodes[2] + SPACING / 2)
    # The four nodes' mean, up to the rounding of a handful of float64 operations on metres.
    assert middle == pytest.approx(ground.grid[2:4, 1:3].mean(), abs=1e-12)


def test_the_ground_repeats_without_a_seam(ground: Ground) -> None:
    x, y = np.array([0.3, -7.25, 11.0]), np.array([4.0, 0.55, -9.9])
    # x + PERIOD rounds to 2e-14 m; the steepest flank (the wall's, 1.5 m in 5 cm) makes that 1e-12 at most.
    assert np.allclose(ground.height(x + PERIOD, y - 3 * PERIOD), ground.height(x, y), rtol=0, atol=1e-10)


def test_the_ground_has_a_wall_and_a_ditch(ground: Ground) -> None:
    wall = ground.height(1.0, 8.8) - ground.height(1.0, [8.4, 9.2]).mean()
    assert wall > 1.0
    y = np.linspace(-10, 10, 41)
    middle = -7.0 - 0.25 * y
    banks = (ground.height(middle - 1.4, y) + ground.height(middle + 1.4, y)) / 2
    # 0.25 m deep everywhere; a rock here or there may lie in it or on its bank: the median doesn't see those.
    assert np.median(banks - ground.height(middle, y)) == pytest.approx(0.25, abs=0.1)


def test_points_lie_on_the_ground_seen_from_the_moving_sensor() -> None:
    # No noise: each point, placed by the pose of its own column, must lie on the ground.
    exact = Scanner(rings=16, columns=64, range_sigma=0.0, beam_sigma=0.0)
    driver = Rover(bare(3), scanner=exact, start_ns=START_NS, speed=3.0)
    message = next(m for m in driver.messages(1.0) if m.kind == "points")
    points, stamps, back = cloud(message)
    pose = driver.pose(stamps[back])
    placed = pose.position + np.einsum("nij,nj->ni", pose.rotation, points[back] + np.asarray(MOUNT))
    error = placed[:, 2] - driver.world.ground.height(placed[:, 0], placed[:, 1])
    assert back.mean() > 0.5
    # Points are float32 (1 micrometre at 25 m); a beam that grazes a flank turns that, and the caster's last
    # half step of 6 micrometres over ground, into up to 30 times as much height.
    assert np.abs(error).max() < 1e-3
    assert np.median(np.abs(error)) < 1e-5


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(world: World) -> None:
    first = list(rover(world, seed=5).messages(0.3))
    assert list(rover(world, seed=5).messages(0.3)) == first
    assert [m.payload for m in rover(world, seed=6).messages(0.3)] != [m.payload for m in first]


def test_poses_enclose_every_sweep(world: World) -> None:
    messages = list(rover(world).messages(1.0))
    poses = [m.stamp_ns for m in messages if m.kind == "odometry"]
    clouds = [cloud(m) for m in messages if m.kind == "points"]
    assert len(clouds) == 10
    assert np.diff(poses).max() == 20_000_000
    assert poses[0] <= min(stamps.min() for _, stamps, _ in clouds)
    assert poses[-1] >= max(stamps.max() for _, stamps, _ in clouds)
    assert [m.due_ns for m in messages] == sorted(m.due_ns for m in messages)


def test_localisation_errs_as_it_says(world: World) -> None:
    errors = []
    for seed in range(60):
        driver = rover(world, seed=seed)
        for message in driver._odometry(0.0):
            said = decode_odometry(message.payload, max_message=1 << 16)
            true = driver.pose(np.array([message.stamp_ns]))
            turned = Rotation.from_matrix(true.rotation[0]) * Rotation.from_quat(said.rotation).inv()
            errors.append(np.concatenate([true.position[0] - said.position, turned.as_rotvec()]))
            assert said.covariance is not None
            assert np.allclose(np.sqrt(np.diag(said.covariance)), POSE_SIGMA)
    # Two poses 20 ms apart of 60 runs: 60 independent draws. The spread of a spread of 60 draws is 1/sqrt(120) = 9 %,
    # the seeds are fixed, and five of those spreads is the bound.
    spread = np.sqrt(np.mean(np.square(errors), axis=0)) / np.asarray(POSE_SIGMA)
    assert np.all(np.abs(spread - 1) < 0.46), spread


def test_robots_share_the_world_and_are_merged_by_time() -> None:
    two = rovers(2, seed=1, start_ns=START_NS, scanner=SMALL)
    assert two[0].world is two[1].world
    apart = two[0].pose(np.array([START_NS])).position - two[1].pose(np.array([START_NS])).position
    assert two[0].name != two[1].name
    messages = list(merged([each.messages(0.4) for each in two]))
    assert {m.robot for m in messages} == {"rover1", "rover2"}
    assert all(a.due_ns <= b.due_ns for a, b in itertools.pairwise(messages))
    first = {m.robot: m.payload for m in reversed(messages) if m.kind == "points"}
    assert first["rover1"] != first["rover2"]
    assert np.isfinite(apart).all()
