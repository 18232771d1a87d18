"""Transforms between frames: ``foxglove.FrameTransform`` from and to numbers."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from numpy.typing import ArrayLike

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

WHAT: Final = "foxglove.FrameTransform"

MAX_FRAME: Final = 256
"""Characters of a frame's name. Names are kept, so their length must be bounded."""


@dataclass(frozen=True, slots=True)
class Transform:
    """The pose of ``child_frame_id`` in ``parent_frame_id`` from ``stamp_ns`` on.

    ``translation`` in metres, ``rotation`` a unit quaternion x, y, z, w.
    """

    stamp_ns: int
    parent_frame_id: str
    child_frame_id: str
    translation: Vector
    rotation: Quaternion


def decode_transform(payload: bytes, *, max_message: int) -> Transform:
    """Read a transform; raises ``MessageFault`` (``too_large``, ``bad_message``)."""
    check_size(payload, WHAT, max_message)
    check_outline(payload, FrameTransform)
    message = parse(payload, FrameTransform)
    if len(message.child_frame_id) > MAX_FRAME:
        raise bad_message(
            f"{WHAT}.child_frame_id: expected at most {MAX_FRAME} characters; found {len(message.child_frame_id)}"
        )
    return Transform(
        read_stamp(message, WHAT),
        message.parent_frame_id,
        message.child_frame_id,
        read_vector(message.translation, f"{WHAT}.translation"),
        read_rotation(message.rotation, f"{WHAT}.rotation"),
    )


def encode_transform(
    stamp_ns: int, parent_frame_id: str, child_frame_id: str, translation: ArrayLike, rotation: ArrayLike
) -> bytes:
    """Return a transform's payload, from arrays of shape (3,) and (4,) x y z w; raises ValueError."""
    message = FrameTransform()
    write_stamp(message, stamp_ns)
    message.parent_frame_id = parent_frame_id
    message.child_frame_id = child_frame_id
    write_vector(message.translation, np.asarray(translation, np.float64).reshape(3))
    write_rotation(message.rotation, np.asarray(rotation, np.float64).reshape(4))
    return bytes(message.SerializeToString())
