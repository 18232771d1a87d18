"""Odometry and transforms: poses, covariances, and which of these can't be one."""

import numpy as np
import pytest
from contract_tools import (
    MIB,
    STAMP,
    few,
    frames,
    many,
    odometry_message,
    quaternions,
    refused,
    stamps,
    transform_message,
    vectors,
)
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry as OdometryMessage
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roughmap_schemas import (
    MessageFault,
    Odometry,
    decode_odometry,
    decode_transform,
    encode_odometry,
    encode_transform,
)
from roughmap_schemas.geometry import normalised

roots = hnp.arrays(np.float64, (6, 6), elements=st.floats(-10, 10).map(lambda v: round(v, 6)))


def read(covariance: object) -> Odometry:
    message = odometry_message(np.asarray(covariance, np.float64).reshape(-1).tolist())
    return decode_odometry(message.SerializeToString(), max_message=MIB)


def unit(rotation: tuple[float, ...]) -> np.ndarray:
    return np.array(rotation) / np.linalg.norm(rotation)


@many
@given(stamps, frames, frames, vectors, quaternions(), st.none() | roots)
def test_odometry_there_and_back(
    stamp: int, frame: str, body: str, position: tuple, rotation: tuple, root: np.ndarray | None
) -> None:
    covariance = None if root is None else root @ root.T
    pose = decode_odometry(encode_odometry(stamp, frame, position, rotation, covariance, body), max_message=MIB)
    assert (pose.stamp_ns, pose.frame_id, pose.body_frame_id, pose.position) == (stamp, frame, body, position)
    np.testing.assert_allclose(pose.rotation, unit(rotation), rtol=0, atol=1e-15)  # a few roundings
    assert not pose.covariance_fault
    if covariance is None or not covariance.any():
        assert pose.covariance is None
    else:
        assert pose.covariance is not None
        assert pose.covariance.tolist() == covariance.tolist()


@few
@given(stamps, frames, frames, vectors, quaternions())
def test_a_transform_there_and_back(stamp: int, parent: str, child: str, translation: tuple, rotation: tuple) -> None:
    got = decode_transform(encode_transform(stamp, parent, child, translation, rotation), max_message=MIB)
    assert (got.stamp_ns, got.parent_frame_id, got.child_frame_id) == (stamp, parent, child)
    assert got.translation == translation
    np.testing.assert_allclose(got.rotation, unit(rotation), rtol=0, atol=1e-15)


def test_foreign_messages_are_read() -> None:
    pose = decode_odometry(odometry_message().SerializeToString(), max_message=MIB)
    assert (pose.stamp_ns, pose.frame_id, pose.body_frame_id) == (STAMP, "map", "base")
    assert (pose.position, pose.rotation, pose.covariance) == ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), None)
    moved = decode_transform(transform_message().SerializeToString(), max_message=MIB)
    assert (moved.stamp_ns, moved.parent_frame_id, moved.child_frame_id) == (STAMP, "map", "odom")
    assert (moved.translation, moved.rotation) == ((4.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def test_foreign_readers_see_what_was_encoded() -> None:
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    covariance[0, 5] = covariance[5, 0] = 0.5
    pose = OdometryMessage.FromString(encode_odometry(STAMP, "odom", (1, 2, 3), (0, 0, 0.6, 0.8), covariance, "base"))
    assert pose.timestamp.seconds * 10**9 + pose.timestamp.nanos == STAMP
    assert (pose.frame_id, pose.body_frame_id, pose.pose.position.z) == ("odom", "base", 3.0)
    assert (pose.pose.orientation.z, pose.pose.orientation.w) == (0.6, 0.8)
    assert list(pose.pose_covariance) == covariance.reshape(36).tolist()  # row-major; here rows and columns are alike
    moved = FrameTransform.FromString(encode_transform(STAMP, "map", "odom", (1, 2, 3), (0, 0, 0.6, 0.8)))
    assert (moved.parent_frame_id, moved.child_frame_id) == ("map", "odom")
    assert (moved.translation.x, moved.rotation.z, moved.rotation.w) == (1.0, 0.6, 0.8)


@many
@given(quaternions())
def test_normalising_twice_is_normalising_once(rotation: tuple) -> None:
    """To the bit: a pose that was read from a message, written and read again places points in the same places."""
    once = normalised(rotation)
    assert once is not None
    assert normalised(once) == once
    assert float(np.linalg.norm(once)) == pytest.approx(1.0, abs=1e-15)


def test_only_what_is_of_length_one_up_to_rounding_stays_as_it_is() -> None:
    """Ten thousand roundings too long: no rounding any more."""
    assert normalised((0.0, 0.0, 0.6 * (1 + 1e-12), 0.8 * (1 + 1e-12))) == pytest.approx((0, 0, 0.6, 0.8), abs=1e-15)


def test_a_quaternion_that_is_not_unit_is_normalised() -> None:
    message = transform_message()
    message.rotation.z, message.rotation.w = 6.0, 8.0
    got = decode_transform(message.SerializeToString(), max_message=MIB)
    np.testing.assert_allclose(got.rotation, (0, 0, 0.6, 0.8), rtol=0, atol=2e-16)
    message.rotation.z, message.rotation.w = 0.0, 1.1e-6
    assert decode_transform(message.SerializeToString(), max_message=MIB).rotation == (0, 0, 0, 1)


def test_a_pose_must_be_there() -> None:
    message = odometry_message()
    message.ClearField("pose")
    refused(
        "bad_message", lambda: decode_odometry(message.SerializeToString(), max_message=MIB), "pose: expected a pose"
    )


@pytest.mark.parametrize("given_numbers", [[], [0.0] * 36])
def test_no_covariance(given_numbers: list[float]) -> None:
    pose = read(given_numbers)
    assert pose.covariance is None
    assert not pose.covariance_fault


def one_entry(row: int, column: int, value: float) -> np.ndarray:
    matrix = np.eye(6)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    "covariance",
    [
        [1.0],
        [0.0] * 35,
        [0.0] * 37,
        one_entry(2, 2, float("nan")),
        one_entry(0, 1, float("nan")),
        one_entry(3, 3, float("inf")),
        one_entry(0, 1, 0.5),
        one_entry(5, 0, 1.1e-6),
    ],
)
def test_what_cannot_be_a_covariance(covariance: object) -> None:
    """The message is taken and logged; the pose is what is rejected (`bad_covariance`), so decoding tells it apart."""
    pose = read(covariance)
    assert pose.covariance_fault
    assert pose.covariance is None


def test_a_negative_variance_is_left_to_the_rules_on_poses() -> None:
    """It may mean that there is no estimate."""
    pose = read(one_entry(4, 4, -1.0))
    assert not pose.covariance_fault
    assert pose.covariance is not None
    assert pose.covariance[4, 4] == -1.0


def test_symmetric_to_a_millionth() -> None:
    matrix = np.eye(6)
    matrix[0, 1], matrix[1, 0] = 0.5, 0.5 + 4e-7
    assert not read(matrix).covariance_fault
    matrix[1, 0] = 0.5 + 2e-6
    assert read(matrix).covariance_fault


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_symmetry_is_relative(scale: float) -> None:
    matrix = np.eye(6)
    matrix[2, 3], matrix[3, 2] = 0.5, 0.5 + 4e-7
    assert not read(matrix * scale).covariance_fault
    matrix[3, 2] = 0.5 + 2e-6
    assert read(matrix * scale).covariance_fault


@pytest.mark.parametrize("shape", [(5, 6), (6,)])
def test_covariances_of_another_shape_are_not_encoded(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="reshape"):
        encode_odometry(0, "map", (0, 0, 0), (0, 0, 0, 1), np.zeros(shape))


def test_a_frames_name_has_a_bound() -> None:
    """Names of frames are kept, so they come from outside with a limit."""
    at_the_limit = encode_transform(5, "map", "o" * 256, (0, 0, 0), (0, 0, 0, 1))
    assert decode_transform(at_the_limit, max_message=1 << 20).child_frame_id == "o" * 256
    beyond = encode_transform(5, "map", "o" * 257, (0, 0, 0), (0, 0, 0, 1))
    with pytest.raises(MessageFault, match=r"bad_message.*child_frame_id: expected at most 256"):
        decode_transform(beyond, max_message=1 << 20)
