"""Known cells as sensor_msgs/PointCloud2."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roughmap_ros.messages.poses import header_of
from roughmap_ros.messages.types import POINT_CLOUD, TYPES, make

FLOAT32: Final = 7


def cells_cdr(
    heights: npt.NDArray[np.floating[Any]],
    layers: Mapping[str, npt.NDArray[Any]],
    origin: tuple[float, float],
    cell_size: float,
    local_origin: tuple[float, float, float],
    stamp_ns: int,
    frame_id: str,
) -> bytes:
    """Write a cloud with a point for each cell whose height is finite: x, y, z and the layers, all float32.

    ``heights`` and each layer (rows along y, columns along x), both from the lowest; ``origin`` is the low corner of
    the first cell in the map's frame, metres. ``frame_id`` is the frame whose origin is ``local_origin`` in the map's:
    float32 would lose half a metre of a UTM northing, so points are given about it. Send it with `tf_cdr`.
    """
    rows, columns = np.nonzero(np.isfinite(heights))
    names = ["x", "y", "z", *layers]
    points = np.empty((len(rows), len(names)), "<f4")
    # In float64, from the difference of the origins on: both may be large.
    points[:, 0] = (origin[0] - local_origin[0]) + (columns + 0.5) * cell_size
    points[:, 1] = (origin[1] - local_origin[1]) + (rows + 0.5) * cell_size
    points[:, 2] = heights[rows, columns].astype(np.float64) - local_origin[2]
    for number, layer in enumerate(layers.values(), 3):
        points[:, number] = layer[rows, columns]
    message = make(
        POINT_CLOUD,
        header=header_of(stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=_fields(names),
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=points.nbytes,
        data=points.reshape(-1).view(np.uint8),
        is_dense=bool(np.isfinite(points[:, :3]).all()),
    )
    return bytes(TYPES.serialize_cdr(message, POINT_CLOUD, little_endian=True))


def _fields(names: Sequence[str]) -> list[object]:
    return [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * number, datatype=FLOAT32, count=1)
        for number, name in enumerate(names)
    ]
