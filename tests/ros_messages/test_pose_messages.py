"""Poses and transforms keep their numbers; what is no pose is refused."""

import math

import numpy as np
import pytest
from ros_cdr_bytes import Cdr, odometry, pose, tf_message
from ros_decoded import decoded_by_mcap

from roughmap_ros.messages import (
    BadRosMessage,
    read_odometry,
    read_pose,
    read_pose_stamped,
    tf_cdr,
    transforms_of,
)
from roughmap_schemas.transform import Transform

POSE = [1.5, -2.25, 3.0, 0.0, 0.0, 0.6, 0.8]
COVARIANCE = [float(n) for n in range(36)]
STAMP = 12_000_000_034


@pytest.mark.parametrize("order", ["<", ">"])
def test_an_odometry_keeps_pose_covariance_and_frames(order: str) -> None:
    read = read_odometry(odometry(POSE + COVARIANCE, frame="/odom", child="/base", order=order))
    assert (read.stamp_ns, read.frame_id, read.body_frame_id) == (STAMP, "odom", "base")
    assert (*read.position, *read.rotation) == tuple(POSE)
    np.testing.assert_array_equal(read.covariance, np.reshape(COVARIANCE, (6, 6)))


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_pose_with_covariance_names_no_body(order: str) -> None:
    read = read_pose(pose(Cdr(order).header(STAMP, "map"), POSE + COVARIANCE).bytes())
    assert (read.stamp_ns, read.frame_id, read.body_frame_id) == (STAMP, "map", "")
    np.testing.assert_array_equal(read.covariance, np.reshape(COVARIANCE, (6, 6)))


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_pose_stamped_has_no_covariance(order: str) -> None:
    read = read_pose_stamped(pose(Cdr(order).header(STAMP, "map"), POSE).bytes())
    assert (*read.position, *read.rotation) == tuple(POSE)
    assert read.covariance is None


def test_a_quaternion_is_brought_to_norm_1() -> None:
    assert read_odometry(odometry([0, 0, 0, 0, 0, 3, 4, *COVARIANCE])).rotation == (0, 0, 0.6, 0.8)


@pytest.mark.parametrize(
    "numbers", [[math.nan, *POSE[1:]], [math.inf, *POSE[1:]], [0.0] * 7, [0, 0, 0, 0, 0, 0, math.nan]]
)
def test_a_pose_that_is_none_is_refused(numbers: list[float]) -> None:
    with pytest.raises(BadRosMessage, match=r"nav_msgs/Odometry: expected a finite position and a quaternion"):
        read_odometry(odometry(numbers + COVARIANCE))


@pytest.mark.parametrize("order", ["<", ">"])
def test_transforms_are_read_in_their_order(order: str) -> None:
    cdr = tf_message([(5, "/map", "odom", POSE), (STAMP, "odom", "/base_link", [0, 0, 0, 0, 0, 0, 1])], order)
    assert transforms_of(cdr) == [
        Transform(5, "map", "odom", (1.5, -2.25, 3.0), (0.0, 0.0, 0.6, 0.8)),
        Transform(STAMP, "odom", "base_link", (0, 0, 0), (0, 0, 0, 1)),
    ]


def test_a_broken_joint_hides_no_other() -> None:
    cdr = tf_message([(5, "base", "wheel", [math.nan] * 7), (5, "base", "lidar", POSE)])
    assert [transform.child_frame_id for transform in transforms_of(cdr)] == ["lidar"]


def test_a_message_of_broken_transforms_alone_is_refused() -> None:
    with pytest.raises(BadRosMessage, match="found none"):
        transforms_of(tf_message([(5, "base", "wheel", [0.0] * 7)]))


def test_no_transforms_are_none() -> None:
    assert transforms_of(tf_message([])) == []


def test_more_transforms_than_any_robot_has_are_refused() -> None:
    with pytest.raises(BadRosMessage, match="expected at most 4096 transforms; found 5000"):
        transforms_of(tf_message([(5, "a", "b", POSE)] * 5000))


def test_transforms_that_go_out_are_read_by_another_decoder() -> None:
    cdr = tf_cdr([Transform(STAMP, "map", "roughmap", (1.5, -2.25, 3.0), (0.0, 0.0, 0.6, 0.8))])
    (transform,) = decoded_by_mcap("tf2_msgs/msg/TFMessage", cdr).transforms
    stamp, moved, turned = transform.header.stamp, transform.transform.translation, transform.transform.rotation
    assert (stamp.sec, stamp.nanosec) == (12, 34)
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "roughmap")
    assert [moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w] == POSE
    assert transforms_of(cdr)[0].child_frame_id == "roughmap"


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_a_stamp_that_ros_can_not_hold_is_refused(stamp_ns: int) -> None:
    with pytest.raises(ValueError, match="expected 0 <= stamp_ns"):
        tf_cdr([Transform(stamp_ns, "a", "b", (0, 0, 0), (0, 0, 0, 1))])
