"""What errors that points have in common leave in the mean height of a cell, worked by hand."""

from typing import Any

import numpy as np
import pytest
from strategies import MODELS, SECOND_NS, START_NS

from roughmap import Noise, RoughMap, Scan, Trajectory
from roughmap.settings import SURFACES

SHARP = np.eye(3) * 1e-8
"""Sigmas of 0.1 mm: a point in the middle of a cell lies in that cell alone, with the weight of any other."""


def trust_of(m: RoughMap) -> Any:
    """The trust of the only known cell."""
    with m.freeze() as frozen:
        ((x, y),) = frozen.tiles.tolist()
        state = frozen.state(x, y)
    (known,) = np.flatnonzero(state.cells["count"])
    return state.trust[known].copy()


def added(model: str, surface: str, stamps: Any, pose_error_time: float = 5.0, **shared: Any) -> Any:
    """The trust after points of one height in one cell, in one call."""
    m = RoughMap(error_model=model, surface=surface, threads=1)
    points = np.tile([0.05, 0.05, 1.0], (len(stamps), 1))
    m.add(points, SHARP, np.array(stamps), pose_error_time=pose_error_time, **shared)
    return trust_of(m)


pytestmark = [pytest.mark.parametrize("model", MODELS), pytest.mark.parametrize("surface", SURFACES)]


def test_points_of_one_pose_are_no_surer_than_one(model: str, surface: str) -> None:
    trust = added(model, surface, [START_NS] * 8, common=1e-4, mount=4e-4)
    assert trust["variance"] == pytest.approx(1e-4, rel=1e-6)
    assert trust["shared"] == pytest.approx(1e-4, rel=1e-6)
    assert trust["pose_variance"] == pytest.approx(1e-4, rel=1e-6)
    assert trust["mount_sigma"] == pytest.approx(0.02, rel=1e-6)
    assert trust["stamp_ms"] == START_NS // 1_000_000 % (1 << 32)


def test_points_of_poses_far_apart_are_independent(model: str, surface: str) -> None:
    """4 tau apart and more: V is that of a mean of independent ones, and L the present one's part."""
    trust = added(model, surface, START_NS + np.arange(4) * 20 * SECOND_NS, common=1e-4)
    assert trust["variance"] == pytest.approx(1e-4 / 4, rel=1e-6)
    assert trust["shared"] == pytest.approx(1e-4 / 4, rel=1e-6)


def test_in_between_by_hand(model: str, surface: str) -> None:
    """Two points half of 4 tau apart: y^4 = 1/16; V = (1/2)(1/2 + 1/16) + 1/4, L = 1/32 + 1/2, in 1e-4."""
    for stamps in ([START_NS, START_NS + 4 * SECOND_NS], [START_NS + 4 * SECOND_NS, START_NS]):
        trust = added(model, surface, stamps, 2.0, common=1e-4)
        assert trust["variance"] == pytest.approx(0.53125e-4, rel=1e-6)
        assert trust["shared"] == pytest.approx(0.53125e-4, rel=1e-6)
        assert trust["stamp_ms"] == stamps[1] // 1_000_000 % (1 << 32)


def test_milliseconds_wrap(model: str, surface: str) -> None:
    wrap = (1 << 32) * 1_000_000
    trust = added(model, surface, [wrap - 2 * SECOND_NS, wrap + 2 * SECOND_NS], 2.0, common=1e-4)
    assert trust["variance"] == pytest.approx(0.53125e-4, rel=1e-6)


def test_means_of_variances_and_sigmas(model: str, surface: str) -> None:
    common, mount = np.array([1e-4, 3e-4, -1.0, 0.0]), np.array([1e-4, 9e-4, 0.0, -2.0])
    trust = added(model, surface, [START_NS] * 4, common=common, mount=mount)
    assert trust["pose_variance"] == pytest.approx(1e-4, rel=1e-6)
    assert trust["mount_sigma"] == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize("worst", [np.nan, np.inf, 1e300])
def test_no_variance_is_too_large(model: str, surface: str, worst: float) -> None:
    trust = added(model, surface, [START_NS] * 3, common=worst, mount=worst)
    assert np.isfinite([trust[name] for name in trust.dtype.names]).all()
    assert trust["variance"] > 1e29


def test_a_scan_takes_what_its_pose_and_its_mounting_do_to_a_height(model: str, surface: str) -> None:
    """The base's roll lifts a point 3 m to its left, the mounting's pitch lowers one 4 m ahead of the sensor."""
    pose = np.zeros((6, 6))
    pose[2, 2], pose[3, 3], pose[2, 3], pose[3, 2] = 1e-6, 4e-6, 1e-6, 1e-6
    way = Trajectory([START_NS], [(0.05, 0.05, 0.0)], [(0, 0, 0, 1)], pose[None])
    noise = Noise(1e-4, 0.0, 1e-5, (0, 0, 2e-3, 0, 1e-3, 0))
    m = RoughMap(error_model=model, surface=surface, threads=1)
    m.add_scan(Scan([(4.0, 2.0, -1.0)], START_NS, translation=(0, 1, 0)), way, noise)
    with m.freeze() as frozen:
        state = frozen.state(0, 0)
    trust = state.trust[state.cells["count"] > 0]
    np.testing.assert_allclose(trust["variance"], 1e-6 + 2 * 3 * 1e-6 + 9 * 4e-6, rtol=1e-6)
    np.testing.assert_allclose(trust["mount_sigma"], np.sqrt(4e-6 + 16 * 1e-6), rtol=1e-6)
