"""Poses composed link by link: at whose stamps, and what they wait for."""

from collections.abc import Iterable

import numpy as np
import pytest
from feed_tools import T0, S, matrix, rigid, transform

from roughmap_ros.tf.composed_poses import ComposedPoses, Stamped
from roughmap_ros.tf.rigid import Rigid
from roughmap_ros.tf.tree import Tree
from roughmap_schemas import Transform

MS = S // 1000


class Driver:
    """A tree with poses of base in map, fed one transform at a time."""

    def __init__(self) -> None:
        self.tree = Tree()
        self.composed = ComposedPoses(self.tree, "map", "base")
        self.got: list[Stamped] = []

    def tf(self, parent: str, child: str, stamp_ms: int, log_ms: int, x: float = 0.0) -> list[int]:
        """Send a transform; return the stamps of the poses that came, in ms."""
        one = transform(parent, child, T0 + stamp_ms * MS, [x, 0, 0, 0, 0, 0])
        self.tree.take([one], static=False, log_ns=T0 + log_ms * MS)
        new = self.composed.new()
        self.got += new
        return [(pose.stamp_ns - T0) // MS for pose in new]

    def stamps(self) -> list[int]:
        """Return the stamps of all poses in ms."""
        return [(pose.stamp_ns - T0) // MS for pose in self.got]


def xs(poses: Iterable[Stamped]) -> list[float]:
    """Return the poses' x."""
    return [pose.pose.translation[0] for pose in poses]


def test_poses_come_at_the_stamps_of_the_fastest_link() -> None:
    one = Driver()
    for ms in range(0, 1000, 10):
        if ms % 100 == 0:
            one.tf("map", "odom", ms, ms, x=ms / 100)
        if ms % 20 == 0:
            one.tf("odom", "base", ms, ms)
    assert one.stamps() == list(range(0, 901, 20))
    np.testing.assert_allclose(xs(one.got), [t / 100 for t in one.stamps()], atol=1e-12)


def test_a_late_link_is_waited_for_until_the_leader_is_200_ms_further() -> None:
    one = Driver()
    one.tf("map", "odom", 0, 0, x=1.0)
    assert one.tf("odom", "base", 0, 0) == [0]
    for ms in range(20, 220, 20):
        assert one.tf("odom", "base", ms, ms) == []
    assert one.tf("odom", "base", 220, 220) == [20]
    assert one.tf("odom", "base", 240, 240) == [40]
    assert xs(one.got) == [1.0] * 3
    assert one.tf("map", "odom", 100, 250, x=2.0) == [60, 80, 100]
    np.testing.assert_allclose(xs(one.got[3:]), [1.6, 1.8, 2.0])


def test_a_late_link_that_never_comes_again_holds_its_newest_pose() -> None:
    one = Driver()
    one.tf("map", "odom", 0, 0, x=3.0)
    for ms in range(0, 5000, 20):
        one.tf("odom", "base", ms, ms, x=ms / 1000)
    assert one.stamps() == list(range(0, 4781, 20))
    np.testing.assert_allclose(xs(one.got), [3 + t / 1000 for t in one.stamps()])
    assert [(p.stamp_ns - T0) // MS for p in one.composed.new(wait=False)] == list(range(4800, 5000, 20))


@pytest.mark.parametrize("fast_ms", [20, 100])
def test_localisation_stamped_into_the_future_does_not_lead(fast_ms: int) -> None:
    """AMCL and slam_toolbox stamp map -> odom up to 1 s ahead, often at a higher rate than the odometry's."""
    one = Driver()
    for ms in range(0, 3000, 5):
        if ms % fast_ms == 0:
            one.tf("map", "odom", ms + 1000, ms)
        if ms % 40 == 5:
            assert all(stamp == ms for stamp in one.tf("odom", "base", ms, ms, x=ms / 1000))
    assert one.stamps() == list(range(1005, 3000, 40))
    np.testing.assert_allclose(xs(one.got), [t / 1000 for t in one.stamps()])
    assert one.composed.early == 25


def test_a_fast_slam_that_is_late_does_not_lead_either() -> None:
    one = Driver()
    for ms in range(0, 2000, 5):
        if ms % 50 == 0:
            one.tf("map", "odom", max(ms - 150, 0), ms)
        if ms % 20 == 5:
            one.tf("odom", "base", ms, ms)
    assert one.stamps() == sorted(set(one.stamps()))
    assert set(one.stamps()) == set(range(5, one.stamps()[-1] + 1, 20))


def test_no_pose_is_given_before_the_first_sample_of_a_link() -> None:
    one = Driver()
    for ms in range(0, 500, 20):
        assert one.tf("odom", "base", ms, ms) == []
    assert one.tf("map", "odom", 490, 500) == []
    assert one.tf("odom", "base", 500, 501) == []
    assert one.tf("map", "odom", 510, 520) == [500]
    assert one.composed.early == 25


def test_poses_go_on_after_the_clock_was_set_back() -> None:
    one = Driver()
    for _ in range(2):
        one.got.clear()
        for ms in range(0, 10_000, 20):
            one.tf("map", "odom", ms, ms)
            one.tf("odom", "base", ms, ms)
        assert one.stamps() == list(range(0, 10_000, 20))


def test_each_pose_comes_once_and_in_order_when_transforms_come_in_disorder() -> None:
    one = Driver()
    stamps = [ms for at in range(0, 2000, 100) for ms in (at + 40, at, at + 80, at + 20, at + 60)]
    for ms in stamps:
        one.tf("map", "odom", ms, ms)
        one.tf("odom", "base", ms, ms)
    assert one.stamps() == sorted(set(one.stamps()))


def test_a_chain_may_go_against_the_links() -> None:
    tree = Tree()
    to_map, to_base = rigid([1, 2, 3, 0.1, 0.2, 0.3]), rigid([4, 5, 6, 0.3, 0.2, 0.1])
    for child, pose in (("map", to_map), ("base", to_base)):
        tree.take([_stamped("odom", child, pose)], static=False, log_ns=T0)
    [found] = ComposedPoses(tree, "map", "base").new()
    expected = np.linalg.inv(matrix(to_map)) @ matrix(to_base)
    np.testing.assert_allclose(matrix(found.pose), expected, atol=1e-12)


def _stamped(parent: str, child: str, pose: Rigid) -> Transform:
    return Transform(T0, parent, child, pose.translation, pose.rotation)
