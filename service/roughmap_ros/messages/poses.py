"""Poses and transforms: nav_msgs/Odometry, PoseWithCovarianceStamped, PoseStamped and tf2_msgs/TFMessage."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roughmap_ros.messages.cdr import CdrReader, Header
from roughmap_ros.messages.types import TF, TYPES, make
from roughmap_schemas.geometry import SECOND_NS, Quaternion, Vector, normalised
from roughmap_schemas.transform import Transform

MAX_TRANSFORMS: Final = 4096
"""Transforms in a message: several for each joint of a robot."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRead:
    """The pose of ``body_frame_id`` in ``frame_id`` at ``stamp_ns``, as a ROS message gave it.

    ``position`` in metres, ``rotation`` a unit quaternion x, y, z, w. ``covariance`` (6, 6) float64 as given, order x y
    z roll pitch yaw, metres and radians; None from a message that has none. ``body_frame_id`` is empty unless the
    message names it: only an Odometry does.
    """

    stamp_ns: int
    frame_id: str
    body_frame_id: str
    position: Vector
    rotation: Quaternion
    covariance: npt.NDArray[np.float64] | None


def read_odometry(cdr: bytes) -> PoseRead:
    """Read a nav_msgs/Odometry; its velocities are left out. Raises ``BadRosMessage``."""
    reader = CdrReader(cdr, "nav_msgs/Odometry")
    header, body = reader.header(), reader.frame()
    numbers = reader.float64s(7 + 36)
    reader.skip(8 * (6 + 36))
    reader.end()
    return _pose(reader, header, body, numbers)


def read_pose(cdr: bytes) -> PoseRead:
    """Read a geometry_msgs/PoseWithCovarianceStamped; raises ``BadRosMessage``."""
    reader = CdrReader(cdr, "geometry_msgs/PoseWithCovarianceStamped")
    header, numbers = reader.header(), reader.float64s(7 + 36)
    reader.end()
    return _pose(reader, header, "", numbers)


def read_pose_stamped(cdr: bytes) -> PoseRead:
    """Read a geometry_msgs/PoseStamped; raises ``BadRosMessage``."""
    reader = CdrReader(cdr, "geometry_msgs/PoseStamped")
    header, numbers = reader.header(), reader.float64s(7)
    reader.end()
    return _pose(reader, header, "", numbers)


def _pose(reader: CdrReader, header: Header, body: str, numbers: Sequence[float]) -> PoseRead:
    """Check a pose: position, quaternion and, if there are more numbers, covariance."""
    where = _placed(numbers)
    if where is None:
        raise reader.bad(f"expected a finite position and a quaternion of norm 1; found {tuple(numbers[:7])}")
    covariance = np.array(numbers[7:]).reshape(6, 6) if len(numbers) > 7 else None
    return PoseRead(header.stamp_ns, header.frame_id, body, *where, covariance)


def _placed(numbers: Sequence[float]) -> tuple[Vector, Quaternion] | None:
    """Return position and unit quaternion, None if they are none."""
    a, b, c, x, y, z, w = numbers[:7]
    unit = normalised((x, y, z, w))
    return None if unit is None or not all(map(math.isfinite, (a, b, c))) else ((a, b, c), unit)


def transforms_of(cdr: bytes) -> list[Transform]:
    """Read a tf2_msgs/TFMessage; raises ``BadRosMessage``.

    Transforms that are not finite or have no rotation are left out, for one broken joint must not hide all others; a
    message of nothing else is refused.
    """
    reader = CdrReader(cdr, "tf2_msgs/TFMessage")
    number = reader.count(MAX_TRANSFORMS, "transforms")
    found = []
    for _ in range(number):
        header, child = reader.header(), reader.frame()
        where = _placed(reader.float64s(7))
        if where is not None:
            found.append(Transform(header.stamp_ns, header.frame_id, child, *where))
    reader.end()
    if number and not found:
        raise reader.bad("expected finite translations and quaternions of norm 1; found none")
    return found


def tf_cdr(transforms: Sequence[Transform]) -> bytes:
    """Write a tf2_msgs/TFMessage."""
    message = make(TF, transforms=[_transform(transform) for transform in transforms])
    return bytes(TYPES.serialize_cdr(message, TF, little_endian=True))


def _transform(transform: Transform) -> object:
    x, y, z = transform.translation
    a, b, c, w = transform.rotation
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header_of(transform.stamp_ns, transform.parent_frame_id),
        child_frame_id=transform.child_frame_id,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=a, y=b, z=c, w=w),
        ),
    )


def header_of(stamp_ns: int, frame_id: str) -> object:
    """Return a std_msgs/Header; ValueError for a stamp that ROS can't hold."""
    return make("std_msgs/msg/Header", stamp=time_of(stamp_ns), frame_id=frame_id)


def time_of(stamp_ns: int) -> object:
    """Return a builtin_interfaces/Time; ValueError for a stamp before 1970 or after 2038, which it can't hold."""
    seconds, nanos = divmod(int(stamp_ns), SECOND_NS)
    if not 0 <= seconds < 2**31:
        raise ValueError(f"stamp_ns: expected 0 <= stamp_ns < 2^31 s, found {stamp_ns}")
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanos)


def pose_of(x: float, y: float) -> object:
    """Return a geometry_msgs/Pose at z = 0, not turned."""
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
