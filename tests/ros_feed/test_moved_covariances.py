"""Covariances about other points and axes, against the derivative of what an error does."""

import math

import numpy as np
import numpy.typing as npt
from feed_tools import T0, S, rigid, transform
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation

from roughmap_ros.tf.covariances import NOT_ESTIMATED, Covariances, moved
from roughmap_ros.tf.rigid import IDENTITY, rotate
from roughmap_ros.tf.tree import Tree

NONE = (0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0, 1.0)


def covariance_of(seed: int) -> npt.NDArray[np.float64]:
    """Return a covariance without zeros."""
    a = np.random.default_rng(seed).normal(size=(6, 6)) * 0.01
    return np.asarray(a @ a.T)


@given(st.integers(0, 1000), st.lists(st.floats(-2, 2), min_size=9, max_size=9))
@examples(50)
def test_a_moved_covariance_is_that_of_the_moved_error(seed: int, v: list[float]) -> None:
    """The error of the other pose, as a function of the first one's, is differentiated numerically."""
    covariance, place = covariance_of(seed), rigid(v[:6])  # place: the old parent frame in the new one
    base, turn = np.array(v[6:]), Rotation.from_quat(place.rotation)  # base: in the body's axes; body not turned
    here = turn.apply(base)

    def error(e: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        wrong = Rotation.from_rotvec(e[3:])
        moved_point = turn.apply(e[:3] + wrong.apply(base))
        return np.concatenate([moved_point - here, (turn * wrong * turn.inv()).as_rotvec()])

    h = 1e-6
    jacobian = np.array([(error(h * axis) - error(-h * axis)) / (2 * h) for axis in np.eye(6)]).T
    found = moved(covariance, place.rotation, rotate(place.rotation, (v[6], v[7], v[8])))
    assert found is not None
    np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, atol=1e-9)
    assert (found == found.T).all()


def test_axes_without_an_estimate_give_nothing_to_the_others() -> None:
    planar = np.diag([0.01, 0.02, 1e6, 1e6, 1e6, 0.03])
    tilted = Rotation.from_euler("zyx", [90, 3, 3], degrees=True).as_quat()
    x, y, z, w = tilted.tolist()
    found = moved(planar, (x, y, z, w), (0.0, 0.0, 0.5))
    assert found is not None
    assert [found[i, i] for i in (2, 3, 4)] == [NOT_ESTIMATED] * 3
    np.testing.assert_allclose(found.diagonal()[[0, 1, 5]], [0.02, 0.01, 0.03], rtol=0.05)


def test_an_axis_that_mixes_with_an_unknown_one_is_unknown() -> None:
    only_y = np.diag([NOT_ESTIMATED, 0.02, 0.01, 0.01, 0.01, 0.01])
    x, y, z, w = Rotation.from_euler("z", 45, degrees=True).as_quat().tolist()
    found = moved(only_y, (x, y, z, w), NONE)
    assert found is not None
    np.testing.assert_allclose(found.diagonal(), [NOT_ESTIMATED, NOT_ESTIMATED, 0.01, 0.01, 0.01, 0.01])


def test_no_estimate_at_all_is_none() -> None:
    marked = np.zeros((6, 6))
    marked[0, 0] = NOT_ESTIMATED
    assert moved(marked, STILL, NONE) is None
    assert moved(np.eye(6) * 1e6, STILL, NONE) is None
    assert moved(np.full((6, 6), 9.0), STILL, (1e200, 0.0, 0.0)) is None
    assert moved(np.full((6, 6), math.nan), STILL, NONE) is None


def test_the_newest_covariance_that_is_not_after_a_pose_counts_for_1_s() -> None:
    kept = Covariances(Tree(), "map", "base")
    for i in range(3):
        kept.take(T0 + i * S, "map", "", np.eye(6) * (i + 1))
    assert kept.of(T0 - 1, IDENTITY) is None
    for stamp, expected in ((T0, 1), (T0 + S - 1, 1), (T0 + S, 2), (T0 + 3 * S, 3)):
        found = kept.of(stamp, IDENTITY)
        assert found is not None
        assert found[0, 0] == expected
    assert kept.of(T0 + 3 * S + 1, IDENTITY) is None


def test_covariances_of_a_clock_before_are_forgotten() -> None:
    kept = Covariances(Tree(), "map", "base")
    kept.take(T0 + 100 * S, "map", "", np.eye(6))
    kept.take(T0, "map", "", np.eye(6) * 2)
    found = kept.of(T0 + 1, IDENTITY)
    assert found is not None
    assert found[0, 0] == 2
    assert kept.of(T0 + 100 * S, IDENTITY) is None


def test_a_covariance_in_odometrys_frame_is_turned_into_the_maps() -> None:
    tree, place = Tree(), [1.0, 2.0, 0.0, 0.0, 0.0, math.pi / 2]
    tree.take([transform("map", "odom", T0, place), transform("base", "wheels", T0, [0, 0, -0.5, 0, 0, 0])],
              static=True, log_ns=T0)  # fmt: skip
    kept = Covariances(tree, "map", "base")
    kept.take(T0, "odom", "wheels", np.diag([4.0, 1.0, 1.0, 0.1, 0.0, 0.0]))
    found = kept.of(T0, rigid(place))
    assert found is not None
    # roll about odom's x is about the map's y; the base 0.5 m above the wheels then errs along the map's x
    expected = np.diag([1.0 + 0.1 * 0.25, 4.0, 1.0, 0.0, 0.1, 0.0])
    expected[0, 4] = expected[4, 0] = 0.1 * 0.5
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_covariance_in_an_unknown_frame_is_not_used_and_named() -> None:
    kept = Covariances(Tree(), "map", "base")
    kept.take(T0, "odom", "", np.eye(6))
    assert kept.of(T0, IDENTITY) is None
    assert kept.unplaced == "odom"
