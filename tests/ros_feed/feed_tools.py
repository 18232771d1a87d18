"""ROS messages for the feed's tests, trees of transforms as 4x4 matrices, and what a feed gave, read back."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roughmap_ros.feed import RobotFeed
from roughmap_ros.messages import tf_cdr
from roughmap_ros.messages.poses import header_of
from roughmap_ros.messages.types import TYPES, make
from roughmap_ros.tf.rigid import Rigid
from roughmap_schemas import Odometry, Transform, decode_cloud, decode_odometry, decode_transform
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.ros2_sections import Ros2RobotConfig

Floats = npt.NDArray[np.float64]
S = 1_000_000_000
T0 = 1_700_000_000 * S
MAX = 10**9
ZEROS = np.zeros((6, 6))


def matrix(pose: Rigid | Transform) -> Floats:
    """Return a pose as a 4x4 matrix, by scipy."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat(pose.rotation).as_matrix()
    found[:3, 3] = pose.translation
    return found


def rigid(values: Sequence[float]) -> Rigid:
    """Return a pose from x, y, z and a rotation vector."""
    x, y, z = (float(v) for v in values[:3])
    a, b, c, w = Rotation.from_rotvec(values[3:]).as_quat().tolist()
    return Rigid((x, y, z), (a, b, c, w))


def from_matrix(m: Floats) -> Rigid:
    """Return the pose that a 4x4 matrix is."""
    return rigid([*m[:3, 3], *Rotation.from_matrix(m[:3, :3]).as_rotvec()])


def transform(parent: str, child: str, stamp_ns: int, values: Sequence[float] = (0, 0, 0, 0, 0, 0)) -> Transform:
    """Return a transform from x, y, z and a rotation vector."""
    pose = rigid(values)
    return Transform(stamp_ns, parent, child, pose.translation, pose.rotation)


def tf(*transforms: Transform) -> bytes:
    """Return a TFMessage."""
    return tf_cdr(transforms)


def _pose(pose: Rigid) -> object:
    x, y, z = pose.translation
    a, b, c, w = pose.rotation
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make("geometry_msgs/msg/Quaternion", x=a, y=b, z=c, w=w),
    )


def _with_covariance(pose: Rigid, covariance: npt.ArrayLike) -> object:
    numbers = np.asarray(covariance, np.float64).reshape(36)
    return make("geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose), covariance=numbers)


def odometry(stamp_ns: int, frame: str, body: str, pose: Rigid, covariance: npt.ArrayLike = ZEROS) -> bytes:
    """Return an Odometry."""
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    message = make(
        "nav_msgs/msg/Odometry",
        header=header_of(stamp_ns, frame),
        child_frame_id=body,
        pose=_with_covariance(pose, covariance),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    return bytes(TYPES.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def pose_with_covariance(stamp_ns: int, frame: str, pose: Rigid, covariance: npt.ArrayLike) -> bytes:
    """Return a PoseWithCovarianceStamped."""
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    message = make(kind, header=header_of(stamp_ns, frame), pose=_with_covariance(pose, covariance))
    return bytes(TYPES.serialize_cdr(message, kind))


def pose_stamped(stamp_ns: int, frame: str, pose: Rigid) -> bytes:
    """Return a PoseStamped."""
    message = make("geometry_msgs/msg/PoseStamped", header=header_of(stamp_ns, frame), pose=_pose(pose))
    return bytes(TYPES.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))


def cloud(stamp_ns: int, frame: str, points: int = 3) -> bytes:
    """Return a PointCloud2."""
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyz")
    ]
    message = make(
        "sensor_msgs/msg/PointCloud2",
        header=header_of(stamp_ns, frame),
        height=1,
        width=points,
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * points,
        data=np.ones(3 * points, np.float32).view(np.uint8),
        is_dense=True,
    )
    return bytes(TYPES.serialize_cdr(message, "sensor_msgs/msg/PointCloud2"))


def feed(mounted: Sequence[str] = (), **settings: object) -> RobotFeed:
    """Return the feed of a robot; clouds on /points."""
    return RobotFeed(Ros2RobotConfig.model_validate({"clouds": ["/points"], **settings}), "map", mounted)


class Got(NamedTuple):
    """What a feed gave, by kind, in order."""

    poses: list[Odometry]
    transforms: list[Transform]
    clouds: list[tuple[str, int]]
    order: str
    """A letter a message: o, t or p."""


def read(messages: Iterable[RobotMessage]) -> Got:
    """Read messages of the contract with its own codecs."""
    got = Got([], [], [], "".join(message.kind[0] for message in messages))
    for message in messages:
        if message.kind is Kind.ODOMETRY:
            got.poses.append(decode_odometry(message.payload, max_message=MAX))
        elif message.kind is Kind.TRANSFORM:
            got.transforms.append(decode_transform(message.payload, max_message=MAX))
        else:
            one = decode_cloud(message.payload, max_message=MAX, max_points=MAX)
            got.clouds.append((one.frame_id, one.stamp_ns))
    return got


def as_rigid(pose: Odometry | Transform) -> Rigid:
    """Return where a message says that something is."""
    return Rigid(pose.position if isinstance(pose, Odometry) else pose.translation, pose.rotation)
