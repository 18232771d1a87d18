"""Poses of a robot's base: ``foxglove.Odometry`` from and to numbers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry as OdometryMessage
from numpy.typing import ArrayLike, NDArray

from roughmap_schemas.faults import bad_message
from roughmap_schemas.geometry import (
    Quaternion,
    Vector,
    read_rotation,
    read_stamp,
    read_vector,
    write_rotation,
    write_stamp,
    write_vector,
)
from roughmap_schemas.wire import check_outline, check_size, parse

WHAT: Final = "foxglove.Odometry"
SYMMETRY: Final = 1e-6
"""How far two mirrored entries may differ, relative to the largest of both and the product of their sigmas."""


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """The pose of ``body_frame_id`` in ``frame_id`` at ``stamp_ns``.

    ``position`` in metres, ``rotation`` a unit quaternion x, y, z, w. ``covariance`` (6, 6) float64, order x y z roll
    pitch yaw about the parent frame's axes, metres and radians; None if the message has none (empty or all zero).
    ``covariance_fault``: the message has no symmetric matrix of finite numbers, and ``covariance`` is None. Variances
    may be negative: -1 means that there is no estimate.
    """

    stamp_ns: int
    frame_id: str
    body_frame_id: str
    position: Vector
    rotation: Quaternion
    covariance: NDArray[np.float64] | None
    covariance_fault: bool = False


def decode_odometry(payload: bytes, *, max_message: int) -> Odometry:
    """Read a pose; raises ``MessageFault`` (``too_large``, ``bad_message``)."""
    check_size(payload, WHAT, max_message)
    check_outline(payload, OdometryMessage)
    message = parse(payload, OdometryMessage)
    stamp_ns = read_stamp(message, WHAT)
    if not message.HasField("pose"):
        raise bad_message(f"{WHAT}.pose: expected a pose; found none")
    position = read_vector(message.pose.position, f"{WHAT}.pose.position")
    rotation = read_rotation(message.pose.orientation, f"{WHAT}.pose.orientation")
    covariance, fault = read_covariance(message.pose_covariance)
    return Odometry(stamp_ns, message.frame_id, message.body_frame_id, position, rotation, covariance, bool(fault))


def read_covariance(given: Sequence[float]) -> tuple[NDArray[np.float64] | None, str]:
    """Return a message's covariance (6, 6), None if it has none or an invalid one, and what is wrong with it or ""."""
    if len(given) == 0:
        return None, ""
    if len(given) != 36:
        return None, f"{'more than 36' if len(given) > 36 else len(given)} numbers instead of 36"
    matrix = np.array(given, np.float64).reshape(6, 6)
    if not matrix.any():
        return None, ""
    if not np.isfinite(matrix).all():
        return None, "a number that is not finite"
    if not (matrix == matrix.T).all() and not _is_nearly_symmetric(matrix):
        return None, "it is not symmetric"
    return matrix, ""


def _is_nearly_symmetric(matrix: NDArray[np.float64]) -> bool:
    variances = [abs(float(value)) for value in matrix.diagonal()]
    for row in range(6):
        for column in range(row + 1, 6):
            upper, lower = float(matrix[row, column]), float(matrix[column, row])
            scale = max(abs(upper), abs(lower), math.sqrt(variances[row]) * math.sqrt(variances[column]))
            if abs(upper - lower) > SYMMETRY * scale:
                return False
    return True


def encode_odometry(
    stamp_ns: int,
    frame_id: str,
    position: ArrayLike,
    rotation: ArrayLike,
    covariance: ArrayLike | None = None,
    body_frame_id: str = "base_link",
) -> bytes:
    """Return a pose's payload, from arrays of shape (3,), (4,) x y z w and (6, 6); raises ValueError."""
    message = OdometryMessage()
    write_stamp(message, stamp_ns)
    message.frame_id = frame_id
    message.body_frame_id = body_frame_id
    write_vector(message.pose.position, np.asarray(position, np.float64).reshape(3))
    write_rotation(message.pose.orientation, np.asarray(rotation, np.float64).reshape(4))
    if covariance is not None:
        message.pose_covariance.extend(np.asarray(covariance, np.float64).reshape(36).tolist())
    return bytes(message.SerializeToString())
