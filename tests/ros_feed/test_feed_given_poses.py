"""Poses of a topic: of another body than the base, and in another frame than the map's."""

import numpy as np
import pytest
from feed_tools import (
    T0,
    S,
    as_rigid,
    cloud,
    feed,
    matrix,
    odometry,
    pose_stamped,
    pose_with_covariance,
    read,
    rigid,
    tf,
    transform,
)

POSE = rigid([3, 4, 0.5, 0.02, -0.03, 0.7])
COVARIANCE = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
MS = S // 1000


def test_odometry_of_the_base_in_the_map_goes_on_as_it_is() -> None:
    one = feed(odometry="/odom")
    got = read(one.take("/odom", odometry(T0, "map", "base_link", POSE, COVARIANCE), T0 + 5))
    [pose] = got.poses
    assert (pose.stamp_ns, pose.frame_id, pose.body_frame_id) == (T0, "map", "base_link")
    assert as_rigid(pose) == POSE
    assert pose.covariance is not None
    assert (pose.covariance == COVARIANCE).all()
    assert one.position == (3.0, 4.0)


def test_a_pose_topic_is_of_the_base() -> None:
    one = feed(pose="/amcl_pose")
    got = read(one.take("/amcl_pose", pose_with_covariance(T0, "map", POSE, COVARIANCE), T0))
    assert got.poses[0].body_frame_id == "base_link"
    assert got.poses[0].covariance is not None
    two = feed(pose_stamped="/pose")
    assert read(two.take("/pose", pose_stamped(T0, "map", POSE), T0)).poses[0].covariance is None
    assert two.problems(T0) == ["/points never came"]


def test_odometry_of_the_footprint_is_corrected_by_tf_and_waits_for_it() -> None:
    one = feed(odometry="/odom")
    link = transform("base_footprint", "base_link", 0, [0.1, 0, 0.4, 0, 0.2, 0])
    assert one.take("/odom", odometry(T0, "map", "base_footprint", POSE, COVARIANCE), T0) == []
    [pose] = read(one.take("/tf_static", tf(link), T0 + 1)).poses
    np.testing.assert_allclose(matrix(as_rigid(pose)), matrix(POSE) @ matrix(link), atol=1e-12)
    assert pose.body_frame_id == "base_link"
    lever = matrix(POSE)[:3, :3] @ link.translation
    turns = np.cross(np.eye(3), lever).T  # its column i: axis i x lever
    change = np.block([[np.eye(3), turns], [np.zeros((3, 3)), np.eye(3)]])
    np.testing.assert_allclose(pose.covariance, change @ COVARIANCE @ change.T, atol=1e-12)
    assert not any("taken as" in line for line in one.problems(T0))


def test_odometry_of_an_unknown_body_is_taken_as_the_bases_after_1_s_and_told() -> None:
    one = feed(odometry="/odom")
    given = []
    for ms in range(0, 1500, 100):
        at = T0 + ms * MS
        given.append(len(read(one.take("/odom", odometry(at, "map", "wheels", POSE), at)).poses))
    assert given == [0] * 10 + [11, 1, 1, 1, 1]
    assert any(
        line == "/odom gives poses of wheels, which are taken as those of base_link: no transform between the two came"
        for line in one.problems(T0 + 2 * S)
    )
    one.take("/tf_static", tf(transform("base_link", "wheels", 0)), T0 + 2 * S)
    one.take("/odom", odometry(T0 + 2 * S, "map", "wheels", POSE), T0 + 2 * S)
    assert not any("taken as" in line for line in one.problems(T0 + 2 * S))


@pytest.mark.parametrize("tf_topics", [{}, {"tf": "", "tf_static": ""}])
def test_odometry_without_a_body_is_taken_as_the_bases_at_once_and_told(tf_topics: dict[str, str]) -> None:
    one = feed(odometry="/odom", **tf_topics)
    assert len(read(one.take("/odom", odometry(T0, "map", "", POSE), T0)).poses) == 1
    assert "/odom names no child_frame_id: its poses are taken as those of base_link" in one.problems(T0)


def test_without_tf_no_pose_waits_for_its_body() -> None:
    one = feed(odometry="/odom", tf="", tf_static="")
    assert len(read(one.take("/odom", odometry(T0, "odom", "wheels", POSE), T0)).poses) == 1
    assert "/odom gives poses in odom; expected map, or transforms to it" in one.problems(T0)


def test_poses_that_wait_come_out_at_the_end() -> None:
    one = feed(odometry="/odom")
    one.take("/odom", odometry(T0, "map", "wheels", POSE), T0)
    assert len(read(one.end()).poses) == 1


def test_odometry_in_its_own_frame_comes_with_that_frames_transforms_where_they_change() -> None:
    one = feed(odometry="/odom")
    order = ""
    told = []
    for ms in range(0, 1000, 20):
        at = T0 + ms * MS
        shift = [float(ms >= 500), 0, 0, 0, 0, 0.1]
        messages = one.take("/tf", tf(transform("map", "odom", at, shift)), at)
        messages += one.take("/odom", odometry(at, "odom", "base_link", POSE), at)
        got = read(messages)
        order, told = order + got.order, told + got.transforms
    assert order == "t" + "o" * 25 + "t" + "o" * 25
    assert [(t.stamp_ns - T0) // MS for t in told] == [0, 500]
    assert [(t.parent_frame_id, t.child_frame_id) for t in told] == [("map", "odom")] * 2
    x, y = (matrix(told[1]) @ matrix(POSE))[:2, 3]
    assert one.position == pytest.approx((x, y), abs=1e-12)


def test_transforms_long_before_the_first_odometry_are_told_as_one() -> None:
    one = feed(odometry="/odom")
    for i in range(100):
        one.take("/tf", tf(transform("map", "odom", T0 + i * S // 10, [i, 0, 0, 0, 0, 0])), T0)
    got = read(one.take("/odom", odometry(T0 + 9 * S + S // 20, "odom", "base_link", POSE), T0))
    assert [t.translation[0] for t in got.transforms] == [90.0, *range(91, 100)]
    assert got.order == "t" * 10 + "o"


def test_a_static_place_of_the_odometrys_frame_holds_at_all_times() -> None:
    one = feed(odometry="/odom")
    one.take("/tf_static", tf(transform("map", "odom", T0, [5, 0, 0, 0, 0, 0])), T0)
    got = read(one.take("/odom", odometry(T0, "odom", "base_link", POSE), T0))
    assert (got.order, got.transforms[0].stamp_ns) == ("to", 0)
    assert read(one.take("/odom", odometry(T0 + S, "odom", "base_link", POSE), T0)).order == "o"


def test_the_first_odometry_waits_for_its_frames_place() -> None:
    one = feed(odometry="/odom")
    assert one.take("/odom", odometry(T0, "odom", "base_link", POSE), T0) == []
    assert read(one.take("/tf", tf(transform("map", "odom", T0 + 3)), T0 + 3)).order == "to"


def test_odometry_in_a_frame_that_is_nowhere_goes_on_after_1_s_and_the_gap_is_named() -> None:
    one = feed(odometry="/odom")
    for ms in range(0, 1000, 20):
        one.take("/tf", tf(transform("odom", "base_link", T0 + ms * MS)), T0 + ms * MS)
    given = [one.take("/odom", odometry(T0 + i * S // 2, "odom", "base_link", POSE), T0 + S) for i in range(4)]
    assert [read(messages).order for messages in given] == ["", "", "ooo", "o"]
    assert "map -> odom never came; /tf has odom -> base_link at 50 Hz" in one.problems(T0 + S)
    assert one.position is None


def test_a_robot_that_stands_gets_a_pose_at_each_cloud_from_static_transforms() -> None:
    one = feed()
    one.take("/tf_static", tf(transform("map", "base_link", 0, [1, 2, 3, 0, 0, 0])), T0)
    got = read(one.take("/points", cloud(T0 + 7, "lidar"), T0 + 7))
    assert (got.order, got.poses[0].stamp_ns, got.poses[0].position) == ("op", T0 + 7, (1.0, 2.0, 3.0))


def test_odometry_goes_on_when_the_clock_was_set_back() -> None:
    one = feed(odometry="/odom")
    for start in (T0 + 100 * S, T0):
        order = ""
        for i in range(20):
            at = start + i * 100 * MS
            if i % 10 == 0:
                one.take("/tf", tf(transform("map", "odom", at)), at)
            one.take("/tf", tf(transform("base_link", "arm", at)), at)
            order += read(one.take("/odom", odometry(at, "odom", "base_link", POSE), at)).order
        assert order.endswith("o" * 20)
