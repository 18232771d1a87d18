"""Foxglove's messages, in protobuf or JSON, as the ROS messages in CDR."""

import json
from typing import Any, Final, TypeVar

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.message import DecodeError, Message
from google.protobuf.timestamp_pb2 import Timestamp

from roughmap_ros.messages import TYPES, tf_cdr
from roughmap_ros.messages.clouds import NUMBERS
from roughmap_ros.messages.poses import header_of
from roughmap_ros.messages.types import ODOMETRY, POINT_CLOUD, POSE_STAMPED, make
from roughmap_schemas.faults import ReportedError
from roughmap_schemas.transform import Transform

M = TypeVar("M", bound=Message)

DATATYPES: Final = {number.code: datatype for datatype, number in NUMBERS.items()}
"""A PointField's ``datatype`` by Foxglove's code for the type of numbers."""


class BadFoxgloveMessage(ReportedError):
    """A message is not of its schema."""


def to_cdr(name: str, data: bytes, *, as_json: bool) -> bytes:
    """Return a message as the ROS message in CDR. Raises BadFoxgloveMessage, or ValueError for a stamp."""
    if name == "foxglove.PointCloud":
        return _cloud_cdr(_read(PointCloud, data, as_json=as_json))
    if name == "foxglove.FrameTransforms":
        return tf_cdr([_transform(one) for one in _read(FrameTransforms, data, as_json=as_json).transforms])
    if name == "foxglove.FrameTransform":
        return tf_cdr([_transform(_read(FrameTransform, data, as_json=as_json))])
    if name == "foxglove.PoseInFrame":
        placed = _read(PoseInFrame, data, as_json=as_json)
        header = header_of(_stamp_ns(placed.timestamp), placed.frame_id)
        message = make(POSE_STAMPED, header=header, pose=_pose(placed.pose))
        return bytes(TYPES.serialize_cdr(message, POSE_STAMPED, little_endian=True))
    return _odometry_cdr(_read(Odometry, data, as_json=as_json))


def _cloud_cdr(cloud: PointCloud) -> bytes:
    p, q = cloud.pose.position, cloud.pose.orientation
    if any((p.x, p.y, p.z, q.x, q.y, q.z)):
        raise BadFoxgloveMessage("foxglove.PointCloud: a pose of its own; expected points in its frame")
    number = len(cloud.data) // max(cloud.point_stride, 1)
    size = number * cloud.point_stride
    message = make(
        POINT_CLOUD,
        header=header_of(_stamp_ns(cloud.timestamp), cloud.frame_id),
        height=1,
        width=number,
        fields=[
            make("sensor_msgs/msg/PointField", name=one.name, offset=one.offset, datatype=DATATYPES[one.type], count=1)
            for one in cloud.fields
        ],
        is_bigendian=False,
        point_step=cloud.point_stride,
        row_step=size,
        data=np.frombuffer(cloud.data, np.uint8, size),
        is_dense=True,
    )
    return bytes(TYPES.serialize_cdr(message, POINT_CLOUD, little_endian=True))


def _odometry_cdr(odometry: Odometry) -> bytes:
    covariance = np.zeros(36)
    if len(odometry.pose_covariance) == 36:
        covariance[:] = odometry.pose_covariance
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    message = make(
        ODOMETRY,
        header=header_of(_stamp_ns(odometry.timestamp), odometry.frame_id),
        child_frame_id=odometry.body_frame_id,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=_pose(odometry.pose), covariance=covariance),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    return bytes(TYPES.serialize_cdr(message, ODOMETRY, little_endian=True))


def _pose(pose: Any) -> object:
    p, q = pose.position, pose.orientation
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=p.x, y=p.y, z=p.z),
        orientation=make("geometry_msgs/msg/Quaternion", x=q.x, y=q.y, z=q.z, w=q.w),
    )


def _transform(one: FrameTransform) -> Transform:
    t, q = one.translation, one.rotation
    places = (t.x, t.y, t.z), (q.x, q.y, q.z, q.w)
    return Transform(_stamp_ns(one.timestamp), one.parent_frame_id, one.child_frame_id, *places)


def _stamp_ns(stamp: Timestamp) -> int:
    return int(stamp.seconds * 1_000_000_000 + stamp.nanos)


def _read(kind: type[M], data: bytes, *, as_json: bool) -> M:
    try:
        if not as_json:
            return kind.FromString(data)
        return ParseDict(_protobuf_times(json.loads(data)), kind(), ignore_unknown_fields=True)
    except (DecodeError, ParseError, ValueError, RecursionError) as error:
        raise BadFoxgloveMessage(f"not a {kind.DESCRIPTOR.full_name}: {' '.join(str(error).split())[:200]}") from None


def _protobuf_times(value: Any) -> Any:
    """Return JSON with its times, {"sec": s, "nsec": ns}, as protobuf's JSON has them."""
    if isinstance(value, list):
        return [_protobuf_times(one) for one in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nsec"}:
        return Timestamp(seconds=value["sec"], nanos=value["nsec"]).ToJsonString()
    return {name: _protobuf_times(one) for name, one in value.items()}
