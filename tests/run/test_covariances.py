"""Covariances of poses: what messages mean by them, what the configuration makes of them, what is none."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from properties import examples
from service_tools import LEVEL, T0, config

from roughmap_schemas import Odometry, PoseReason
from roughmap_service.run.covariances import (
    NOT_ESTIMATED,
    TOLERANCE,
    UNKNOWN_VARIANCE,
    BadCovariance,
    Policy,
    Settled,
    settle,
)
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import Settings

SIGMA = np.array([0.05, 0.06, 0.07, 0.01, 0.02, 0.03])
OWN = SIGMA**2
"""The variances of `input.pose_sigma`."""

POLICIES = get_args(Policy)


def given_by(settled: Settled) -> np.ndarray:
    assert settled.covariance is not None
    return settled.covariance


def random_covariance(seed: int, *, scale: float = 0.1, conditioned: float = 1e-3) -> np.ndarray:
    """A symmetric matrix whose correlations have no eigenvalue below ``conditioned``."""
    random = np.random.default_rng(seed)
    half = random.normal(size=(6, 6))
    c = half @ half.T
    sigmas = np.sqrt(np.diag(c))
    r = c / np.outer(sigmas, sigmas)
    r = (r + conditioned * np.eye(6)) / (1 + conditioned)
    spread = scale * np.exp(random.uniform(-4.0, 0.0, 6))
    c = r * np.outer(spread, spread)
    return np.triu(c) + np.triu(c, 1).T


def correlations(c: np.ndarray) -> np.ndarray:
    sigmas = np.sqrt(np.diag(c))
    sigmas = np.where(sigmas > 0.0, sigmas, 1.0)
    return c / np.outer(sigmas, sigmas)


def is_covariance(c: np.ndarray) -> bool:
    """Symmetric, and no eigenvalue of the correlations below 0 by more than rounding: elimination of 6 rows whose
    entries are at most 1, and eigvalsh itself, are off by some 6 x 6 roundings of 2.2e-16 each, so 1e-13 is ample."""
    return bool((c == c.T).all() and (np.diag(c) >= 0.0).all() and np.linalg.eigvalsh(correlations(c)).min() > -1e-13)


def test_none_is_the_configured_one() -> None:
    for policy in POLICIES:
        assert settle(None, SIGMA, policy) == Settled(None)


@pytest.mark.parametrize("policy", POLICIES)
def test_minus_one_in_the_first_place_alone_says_that_nothing_is_estimated(policy: Policy) -> None:
    """As in ROS's sensor messages."""
    c = np.zeros((6, 6))
    c[0, 0] = -1.0
    assert settle(c, SIGMA, policy) == Settled(None, (0, 1, 2, 3, 4, 5))


@pytest.mark.parametrize("number", [NOT_ESTIMATED, "limit", 1e5, 1e6, 1e9, 1.7e308])
@pytest.mark.parametrize("axis", range(6))
def test_what_is_not_estimated_is_the_configuration_s(axis: int, number: float | str) -> None:
    """Row and column: a correlation with what is not known says nothing."""
    c = random_covariance(axis)
    c[axis, axis] = UNKNOWN_VARIANCE[axis] if number == "limit" else float(number)
    settled = settle(c, SIGMA, "message")
    assert settled.unestimated == (axis,)
    expected = c.copy()
    expected[axis] = expected[:, axis] = 0.0
    expected[axis, axis] = OWN[axis]
    np.testing.assert_array_equal(given_by(settled), expected)


@pytest.mark.parametrize("axis", range(6))
def test_large_variances_below_the_limit_are_numbers(axis: int) -> None:
    c = random_covariance(axis)
    c[axis, axis] = np.nextafter(UNKNOWN_VARIANCE[axis], 0.0)
    settled = settle(c, SIGMA, "message")
    assert (settled.unestimated, given_by(settled)[axis, axis]) == ((), c[axis, axis])


FROM_THE_FIELD = {
    "diff_drive_controller": np.diag([0.001, 0.001, 1e6, 1e6, 1e6, 1e3]),
    "Gazebo's planar plugin": np.diag([1e-5, 1e-5, 1e12, 1e12, 1e12, 1e-3]),
    "robot_localization before its first z": np.diag([0.01, 0.01, 1e6, 1e6, 1e6, 0.03]),
    "-1 for each that is not measured": np.diag([0.01, 0.01, -1.0, -1.0, -1.0, 0.03]),
}


@pytest.mark.parametrize("name", FROM_THE_FIELD)
def test_wheel_odometry_of_the_field(name: str) -> None:
    """It estimates x, y and perhaps yaw; the others stay what the configuration says."""
    c = FROM_THE_FIELD[name]
    settled = settle(c, SIGMA, "message")
    variances = np.diag(given_by(settled))
    known = (np.diag(c) >= 0.0) & (np.diag(c) < UNKNOWN_VARIANCE)
    assert settled.unestimated == tuple(np.flatnonzero(~known))
    assert 2 <= known.sum() <= 3
    np.testing.assert_array_equal(variances, np.where(known, np.diag(c), OWN))


def test_a_planar_estimate_has_zeros() -> None:
    """AMCL's: x, y and yaw, correlated, and zeros for what it does not look at; they are numbers like others."""
    c = np.zeros((6, 6))
    c[np.ix_([0, 1, 5], [0, 1, 5])] = [[0.2, 0.05, 0.01], [0.05, 0.3, -0.02], [0.01, -0.02, 0.07]]
    np.testing.assert_array_equal(given_by(settle(c, SIGMA, "message")), c)
    floored = given_by(settle(c, SIGMA, "floor"))
    np.testing.assert_array_equal(np.diag(floored), [0.2, 0.3, OWN[2], OWN[3], OWN[4], 0.07])
    np.testing.assert_array_equal(floored[np.ix_([0, 1, 5], [0, 1, 5])], c[np.ix_([0, 1, 5], [0, 1, 5])])
    assert is_covariance(floored)


def test_all_zeros_are_certain_or_floored() -> None:
    zeros = np.zeros((6, 6))
    np.testing.assert_array_equal(given_by(settle(zeros, SIGMA, "message")), zeros)
    np.testing.assert_array_equal(given_by(settle(zeros, SIGMA, "cap")), zeros)
    np.testing.assert_array_equal(given_by(settle(zeros, SIGMA, "floor")), np.diag(OWN))


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("c", [-np.eye(6) * 1e-9, np.diag([1.0, 1, 1, 1, 1, -0.5]), np.diag([-2.0, 1, 1, 1, 1, 1])])
def test_a_negative_variance_is_none(c: np.ndarray, policy: Policy) -> None:
    with pytest.raises(BadCovariance, match="is negative"):
        settle(c, SIGMA, policy)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_correlation_over_one_is_none(policy: Policy) -> None:
    c = np.eye(6)
    c[0, 1] = c[1, 0] = 1.001
    with pytest.raises(BadCovariance, match=r"covariance 1\.001 is larger than its variances allow"):
        settle(c, SIGMA, policy)
    c = np.zeros((6, 6))
    c[0, 1] = c[1, 0] = 1e-9
    with pytest.raises(BadCovariance, match="is larger than its variances allow"):
        settle(c, SIGMA, policy)


@pytest.mark.parametrize("policy", POLICIES)
def test_correlations_that_contradict_each_other_are_none(policy: Policy) -> None:
    """Each pair is fine; but a with b, b with c and a against c can't be."""
    c = np.eye(6)
    c[0, 1] = c[1, 0] = c[1, 2] = c[2, 1] = 0.9
    c[0, 2] = c[2, 0] = -0.9
    with pytest.raises(BadCovariance, match="not positive semidefinite"):
        settle(c, SIGMA, policy)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 50.0])
@pytest.mark.parametrize(("below", "good"), [(0.5, True), (0.99, True), (1.01, False), (30.0, False)])
def test_a_little_below_zero_is_rounding(below: float, good: bool, scale: float) -> None:
    """Two correlations of 1 + d have the eigenvalue -d; at any scale and any mixture of units."""
    c = np.eye(6)
    c[0, 5] = c[5, 0] = -(1.0 + below * TOLERANCE)
    units = np.sqrt(scale) * np.array([1, 1, 1, 1, 1, 1e-4])
    c *= np.outer(units, units)
    if not good:
        with pytest.raises(BadCovariance):
            settle(c, SIGMA, "message")
        return
    result = given_by(settle(c, SIGMA, "message"))
    assert is_covariance(result)
    np.testing.assert_allclose(np.diag(result), np.diag(c) * (1 + TOLERANCE), rtol=1e-15)
    off = ~np.eye(6, dtype=bool)
    np.testing.assert_array_equal(result[off], c[off])


def test_what_is_not_estimated_may_contradict() -> None:
    """It is replaced before anything else is looked at."""
    c = np.eye(6) * 0.01
    c[2, 2] = -1.0
    c[2, :2] = c[:2, 2] = 7.0
    assert is_covariance(given_by(settle(c, SIGMA, "message")))


def test_configured_uses_none_of_it_but_it_must_be_a_covariance() -> None:
    assert settle(random_covariance(1), SIGMA, "configured") == Settled(None)
    c = random_covariance(1)
    c[2, 2] = 1e6
    assert settle(c, SIGMA, "configured") == Settled(None, (2,))


def test_the_message_s_matrix_is_not_touched() -> None:
    c = random_covariance(3)
    c[2, 2] = 1e6
    before = c.copy()
    for policy in POLICIES:
        settle(c, SIGMA, policy)
    np.testing.assert_array_equal(c, before)


seeds = st.integers(0, 2**32 - 1)
scales = st.sampled_from([1e-9, 1e-3, 0.1, 1.0])


@examples(200)
@given(seeds, scales)
def test_a_covariance_passes_unchanged(seed: int, scale: float) -> None:
    c = random_covariance(seed, scale=scale)
    settled = settle(c, SIGMA, "message")
    assert settled.unestimated == ()
    assert given_by(settled).tobytes() == c.tobytes()


@examples(200)
@given(seeds, scales, st.sampled_from(["floor", "cap"]))
def test_bounds_keep_the_correlations(seed: int, scale: float, policy: Policy) -> None:
    c = random_covariance(seed, scale=scale)
    result = given_by(settle(c, SIGMA, policy))
    bounded = np.maximum(np.diag(c), OWN) if policy == "floor" else np.minimum(np.diag(c), OWN)
    np.testing.assert_array_equal(np.diag(result), bounded)
    # Two scalings and a quotient of numbers of one size: a few roundings of 1.
    np.testing.assert_allclose(correlations(result), correlations(c), atol=4e-15)
    assert is_covariance(result)
    inside = np.diag(c) == bounded
    np.testing.assert_array_equal(result[np.ix_(inside, inside)], c[np.ix_(inside, inside)])


numbers = st.one_of(
    st.just(0.0),
    st.just(-1.0),
    st.floats(-1.0, 1.0),
    st.floats(0.0, 1e7),
    st.floats(-1e-12, 1e-12),
    st.floats(0.9, 1.1),
)  # fmt: skip


@st.composite
def matrices(draw: st.DrawFn) -> np.ndarray:
    """Symmetric ones: of any numbers; of fewer ranks than rows, whose eigenvalues may fall below 0 by rounding; with
    some lifted to or above the limits."""
    if draw(st.booleans()):
        c = draw(arrays(np.float64, (6, 6), elements=numbers))
    else:
        half = np.random.default_rng(draw(seeds)).normal(size=(6, draw(st.integers(1, 5))))
        c = half @ half.T * draw(st.sampled_from([1e-12, 1e-3, 1.0]))
    c = np.triu(c) + np.triu(c, 1).T
    for axis in draw(st.sets(st.integers(0, 5), max_size=3)):
        c[axis, axis] = draw(st.sampled_from([-1.0, 1e4, 1e6, 1e12, 1.7e308]))
    return c


@examples(400)
@given(matrices(), st.sampled_from(POLICIES))
def test_any_matrix_gives_a_covariance_or_is_refused(c: np.ndarray, policy: Policy) -> None:
    try:
        settled = settle(c, SIGMA, policy)
    except BadCovariance:
        known = [i for i in range(6) if c[i, i] != NOT_ESTIMATED and c[i, i] < UNKNOWN_VARIANCE[i]]
        part = c[np.ix_(known, known)]
        # Refused only if it is none: an eigenvalue below 0, or a covariance beside a variance of nearly 0.
        sigmas = np.sqrt(np.maximum(np.diag(part), 0.0))
        too_large = bool((np.abs(part) > np.outer(sigmas, sigmas)).any())
        assert too_large or np.linalg.eigvalsh(correlations(part)).min() < 0.0
        return
    if settled.covariance is not None:
        assert is_covariance(settled.covariance)
        assert settled.covariance.max() < max(UNKNOWN_VARIANCE) * (1 + 2 * TOLERANCE)
    assert settle(c, SIGMA, policy).unestimated == settled.unestimated


@examples(100)
@given(st.integers(1, 5), seeds)
def test_a_matrix_of_fewer_ranks_is_a_covariance(rank: int, seed: int) -> None:
    """As filters give them: a row may be a mixture of others, and eigenvalues are 0 but for rounding."""
    half = np.random.default_rng(seed).normal(size=(6, rank))
    c = half @ half.T * 1e-4
    c = np.triu(c) + np.triu(c, 1).T
    result = given_by(settle(c, SIGMA, "message"))
    assert is_covariance(result)
    np.testing.assert_allclose(result, c, rtol=2 * TOLERANCE)


def robot(**own: object) -> Robot:
    return Robot(Settings(config(robots={"rover": own})), "rover")


@pytest.mark.parametrize("policy", POLICIES)
def test_each_robot_has_its_policy(policy: Policy) -> None:
    c = np.diag([1e-4, 9.0, 1e-4, 1e-6, 1.0, 1e-6])
    r = robot(pose_covariance=policy)
    assert r.take_odometry(Odometry(T0, "map", "base", (0.0, 0.0, 0.0), LEVEL, c), 1, 0).settled == [None]
    (pose,) = r.buffer.poses
    expected = settle(c, r.settings.pose_sigma, policy).covariance
    if expected is None:
        assert pose.covariance is None
    else:
        np.testing.assert_array_equal(pose.covariance, expected)


def test_a_robot_tells_what_is_wrong() -> None:
    r = robot()
    taken = r.take_odometry(Odometry(T0, "map", "base", (0.0, 0.0, 0.0), LEVEL, -np.eye(6) * 0.5), 1, 0)
    assert (taken.settled, taken.why) == ([PoseReason.BAD_COVARIANCE], "variance -0.5 is negative")
    assert robot(pose_covariance="configured").take_odometry(
        Odometry(T0, "map", "base", (0.0, 0.0, 0.0), LEVEL, -np.eye(6) * 0.5), 1, 0
    ).settled == [PoseReason.BAD_COVARIANCE]


@pytest.mark.parametrize(("variance", "unestimated"), [(1e6, True), (1e3, False)])
def test_a_robot_tells_what_was_not_estimated(variance: float, unestimated: bool) -> None:
    c = np.diag([0.01, 0.01, variance, 0.01, 0.01, 0.01])
    taken = robot().take_odometry(Odometry(T0, "map", "base", (0.0, 0.0, 0.0), LEVEL, c), 1, 0)
    assert (taken.settled, taken.unestimated) == ([None], unestimated)


@pytest.mark.parametrize("policy", ["floor", "cap"])
def test_the_smallest_variance_there_is_can_be_scaled(policy: Policy) -> None:
    """By a factor that no float holds."""
    c = np.diag([5e-324, *[1e-300] * 5])
    c[0, 1] = c[1, 0] = 5e-324
    c[3, 4] = c[4, 3] = 1e-300
    got = given_by(settle(c, SIGMA, policy))
    assert is_covariance(got)
    np.testing.assert_allclose(np.diag(got), OWN if policy == "floor" else np.diag(c), rtol=1e-5)
